"""Reference numbers for tests/pose_convert.rs, made by the tools themselves.

    python3 -m venv V && V/bin/pip install numpy scipy opencv-python-headless itk itk-rtk killeengeo
    V/bin/pip download --no-deps --no-binary :all: deepdrr==1.2.2 && tar xzf deepdrr-1.2.2.tar.gz
    V/bin/python make.py tools DEEPDRR-SOURCE OUT-FOLDER       numbers and files as the tools write them
    V/bin/python make.py read FOLDER-OF-OUR-FILES OUT-FOLDER   what the tools read from files that sidecarm wrote

The poses are drawn here, with numpy; nothing of sidecarm is used.
"""
import importlib.util
import json
import os
import sys
import tempfile
import types

import cv2
import itk
import killeengeo as geo
import numpy as np
from itk import RTK as rtk
from scipy.spatial.transform import Rotation

PHANTOM = np.array([[0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 55], [-12, 17, -23]], dtype=float)


def poses():
    rng = np.random.default_rng(11)
    for n in range(8):
        pitch = 0.194 * rng.uniform(3.0, 4.5)
        fx = rng.uniform(950, 1250) / pitch
        fy = fx if n < 4 else fx * rng.uniform(0.9, 1.1)
        size = [int(rng.integers(500, 700)), int(rng.integers(500, 700))]
        middle = (np.array(size) - 1) / 2
        cx, cy = middle + rng.uniform(-20, 20, 2)
        matrix = Rotation.random(random_state=100 + n).as_matrix()
        t = np.array([rng.uniform(-20, 20), rng.uniform(-20, 20), rng.uniform(500, 750)])
        k = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        camera = np.eye(4)
        camera[:3, :3] = matrix
        camera[:3, 3] = t
        yield {"k": k, "camera": camera, "size": size, "pitch": pitch}


def plain(pose):
    return {
        "intrinsics": pose["k"].tolist(),
        "camera_from_lps": pose["camera"].tolist(),
        "size_px": pose["size"],
        "pitch_mm": pose["pitch"],
        "projection": (pose["k"] @ pose["camera"][:3]).tolist(),
    }


def text_of(write, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "file" + suffix)
        write(path)
        with open(path) as file:
            return file.read()


def save(folder, name, origin, content):
    with open(os.path.join(folder, name), "w") as file:
        json.dump({"origin": origin, "phantom_lps_mm": PHANTOM.tolist(), **content}, file, indent=1)
        file.write("\n")


def opencv_yaml(pose, with_rt):
    rvec, _ = cv2.Rodrigues(pose["camera"][:3, :3])
    tvec = pose["camera"][:3, 3:4].copy()

    def write(path):
        fs = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
        fs.write("image_width", pose["size"][0])
        fs.write("image_height", pose["size"][1])
        fs.write("camera_matrix", pose["k"])
        fs.write("distortion_coefficients", np.zeros((5, 1)))
        if with_rt:
            fs.write("avg_reprojection_error", 0.125)
            fs.write("extrinsic_parameters", np.hstack([rvec.T, tvec.T]))
        else:
            fs.write("rvec", rvec)
            fs.write("tvec", tvec)
        fs.release()

    points, _ = cv2.projectPoints(PHANTOM, rvec, tvec, pose["k"], np.zeros(5))
    return {"yaml": text_of(write, ".yml"), "image_px": points.reshape(-1, 2).tolist()}


def physical(pose):
    """Detector millimetres from pixels: u to the right, v up, the origin in the middle of the panel."""
    columns, rows = pose["size"]
    pitch = pose["pitch"]
    pitch_y = pitch * pose["k"][0, 0] / pose["k"][1, 1]
    return np.array([[pitch, 0, -pitch * (columns - 1) / 2], [0, -pitch_y, pitch_y * (rows - 1) / 2], [0, 0, 1.0]]), pitch_y


def rtk_geometry(pose):
    scale, pitch_y = physical(pose)
    matrix = scale @ pose["k"] @ pose["camera"][:3]
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    assert geometry.AddProjection(itk.matrix_from_array(matrix))

    def write(path):
        writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
        writer.SetFilename(path)
        writer.SetObject(geometry)
        writer.WriteFile()

    return geometry, pitch_y, text_of(write, ".xml")


def drawn_by_rtk(geometry, pose, pitch_y):
    """Centres of the shadows (column, row) of spheres of 3 mm, as RTK's ray tracer draws them."""
    image = itk.Image[itk.F, 3]
    centres = []
    for point in PHANTOM:
        source = rtk.ConstantImageSource[image].New()
        columns, rows = pose["size"]
        source.SetOrigin([-pose["pitch"] * (columns - 1) / 2, pitch_y * (rows - 1) / 2, 0])
        source.SetSpacing([pose["pitch"], pitch_y, 1])
        source.SetDirection(itk.matrix_from_array(np.diag([1.0, -1.0, 1.0])))
        source.SetSize([columns, rows, 1])
        draw = rtk.RayEllipsoidIntersectionImageFilter[image, image].New()
        draw.SetInput(source.GetOutput())
        draw.SetGeometry(geometry)
        draw.SetDensity(1.0)
        draw.SetCenter(point.tolist())
        draw.SetAxis([3.0, 3.0, 3.0])
        draw.Update()
        picture = itk.array_from_image(draw.GetOutput())[0].astype(float)
        assert picture.sum() > 0
        row, column = np.indices(picture.shape)
        centres.append([(column * picture).sum() / picture.sum(), (row * picture).sum() / picture.sum()])
    return centres


def rtk_case(pose):
    geometry, pitch_y, xml = rtk_geometry(pose)
    return {"xml": xml, "pitch_y_mm": pitch_y, "drawn_px": drawn_by_rtk(geometry, pose, pitch_y)}


def itk_case(pose, centre):
    transform = itk.AffineTransform[itk.D, 3].New()
    transform.SetCenter(centre)
    transform.SetMatrix(itk.matrix_from_array(pose["camera"][:3, :3].copy()))
    transform.SetOffset(pose["camera"][:3, 3].tolist())
    mapped = [list(transform.TransformPoint(point.tolist())) for point in PHANTOM]
    return {"tfm": text_of(lambda path: itk.transformwrite([transform], path), ".tfm"), "mapped_mm": mapped}


def deepdrr_devices(source):
    """DeepDRR's own MobileCArm, loaded without the package's CUDA parts."""
    package = types.ModuleType("deepdrr")
    package.__path__ = []
    utils = types.ModuleType("deepdrr.utils")
    utils.radians = lambda angle, degrees=True: np.radians(angle) if degrees else angle
    utils.try_import_pyvista = lambda: (None, False)
    devices = types.ModuleType("deepdrr.device")
    devices.__path__ = []
    geo.Rotation = Rotation
    package.geo, package.utils = geo, utils
    sys.modules.update({"deepdrr": package, "deepdrr.geo": geo, "deepdrr.utils": utils, "deepdrr.device": devices})
    sys.modules.setdefault("pyvista", types.ModuleType("pyvista"))
    for name in ["device", "mobile_carm"]:
        spec = importlib.util.spec_from_file_location(f"deepdrr.device.{name}", f"{source}/deepdrr/device/{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[f"deepdrr.device.{name}"] = module
        spec.loader.exec_module(module)
    return sys.modules["deepdrr.device.mobile_carm"].MobileCArm


def world_from_lps(position):
    """`Volume.supine` and `Volume.prone` of DeepDRR (head towards -x); feet first is either turned by 180 degrees about world z."""
    supine = Rotation.from_euler("xz", [90, -90], degrees=True).as_matrix()
    prone = Rotation.from_euler("xz", [-90, 90], degrees=True).as_matrix()
    world_from_ras = supine if position.endswith("S") else prone
    if position.startswith("FF"):
        world_from_ras = np.diag([-1, -1, 1]) @ world_from_ras
    return world_from_ras @ np.diag([-1, -1, 1])


def deepdrr_angle_cases(mobile_carm):
    for position in ["HFS", "HFP", "FFS", "FFP"]:
        for alpha in [-35, 20]:
            for beta in [-25, 40]:
                for gamma in [-15, 10]:
                    carm = mobile_carm(isocenter=[0, 0, 0], alpha=alpha, beta=beta, gamma=gamma, sensor_height=480,
                                       sensor_width=620, pixel_size=0.5, source_to_detector_distance=1020)
                    projection = carm.get_camera_projection()
                    turn = world_from_lps(position)
                    # DeepDRR's first pixel has its centre at (0.5, 0.5): its kernel casts the ray of pixel n through n + 0.5.
                    index = [np.array(projection @ geo.point(*(turn @ point)))[:2] - 0.5 for point in PHANTOM]
                    source = turn.T @ np.array(projection.center_in_world)[:3]
                    yield {
                        "position": position, "alpha_deg": alpha, "beta_deg": beta, "gamma_deg": gamma,
                        "source_to_isocentre_mm": 530.0, "focal_px": 1020 / 0.5,
                        "principal_point_px": [309.5, 239.5],
                        "image_px": np.array(index, dtype=float).tolist(),
                        "source_in_lps_mm": np.array(source, dtype=float).tolist(),
                    }


def deepdrr_case(pose):
    world_from_ras = np.eye(4)
    extrinsic = pose["camera"] @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ world_from_ras
    k = pose["k"].copy()
    k[:2, 2] += 0.5
    projection = geo.CameraProjection(geo.CameraIntrinsicTransform(k, pose["size"][1], pose["size"][0]), extrinsic)
    config = projection.get_config()
    config["extrinsic"] = extrinsic.tolist()
    index = [np.array(projection @ geo.point(*(point * [-1, -1, 1])))[:2] - 0.5 for point in PHANTOM]
    return {"config": config, "image_px": np.array(index, dtype=float).tolist()}


def make(source, out):
    drawn = list(poses())
    versions = {"opencv": f"opencv-python-headless {cv2.__version__}", "itk": f"itk {itk.Version.GetITKVersion()}"}
    save(out, "opencv.json", {
        "tool": versions["opencv"],
        "lines": "make.py opencv_yaml: cv2.FileStorage.write, cv2.Rodrigues, cv2.projectPoints",
    }, {"cases": [{**plain(p), **opencv_yaml(p, n % 2 == 1)} for n, p in enumerate(drawn)]})
    save(out, "rtk.json", {
        "tool": "itk-rtk 2.7.0.post1, " + versions["itk"],
        "lines": "make.py rtk_geometry, drawn_by_rtk: ThreeDCircularProjectionGeometry.AddProjection(matrix), "
                 "ThreeDCircularProjectionGeometryXMLFileWriter, RayEllipsoidIntersectionImageFilter on a panel with direction (1,0;0,-1)",
    }, {"cases": [{**plain(p), **rtk_case(p)} for p in drawn]})
    save(out, "itk.json", {
        "tool": versions["itk"],
        "lines": "make.py itk_case: AffineTransform[D,3].SetCenter/SetMatrix/SetOffset, transformwrite, TransformPoint",
    }, {"cases": [{**plain(p), **itk_case(p, [0, 0, 0] if n % 2 == 0 else [5.5, -7.25, 11.0])} for n, p in enumerate(drawn)]})
    mobile_carm = deepdrr_devices(source)
    save(out, "deepdrr.json", {
        "tool": "deepdrr 1.2.2 (device/mobile_carm.py) with killeengeo 0.0.5, which holds every matrix in float32",
        "lines": "make.py deepdrr_case, deepdrr_angle_cases: CameraProjection, MobileCArm.get_camera_projection; "
                 "positions from Volume.supine and Volume.prone, pixel centres from project_kernel.cu (u = n + 0.5)",
    }, {"cases": [{**plain(p), **deepdrr_case(p)} for p in drawn], "angles": list(deepdrr_angle_cases(mobile_carm))})


def read(folder, out):
    """What each tool reads from files that sidecarm wrote (named 0.yml, 0.xml, 0.tfm, 0.deepdrr.json, ...)."""
    cases = []
    for n, pose in enumerate(poses()):
        path = lambda suffix: os.path.join(folder, f"{n}.{suffix}")
        fs = cv2.FileStorage(path("yml"), cv2.FILE_STORAGE_READ)
        node = lambda key: fs.getNode(key).mat()
        points, _ = cv2.projectPoints(PHANTOM, node("rvec"), node("tvec"), node("camera_matrix"), node("distortion_coefficients"))
        opencv = {"image_px": points.reshape(-1, 2).tolist(),
                  "size_px": [int(fs.getNode("image_width").real()), int(fs.getNode("image_height").real())]}
        reader = rtk.ThreeDCircularProjectionGeometryXMLFileReader.New()
        reader.SetFilename(path("xml"))
        reader.GenerateOutputInformation()
        geometry = reader.GetOutputObject()
        scale, _ = physical(pose)
        matrix = np.linalg.inv(scale) @ np.array(geometry.GetMatrix(0))
        homogeneous = (matrix @ np.hstack([PHANTOM, np.ones((5, 1))]).T).T
        transform = itk.transformread(path("tfm"))[0]
        with open(path("deepdrr.json")) as file:
            projection = geo.CameraProjection.from_config(json.load(file))
        index = [np.array(projection @ geo.point(*(point * [-1, -1, 1])))[:2] - 0.5 for point in PHANTOM]
        texts = {}
        for suffix in ["yml", "xml", "tfm", "deepdrr.json"]:
            with open(path(suffix)) as file:
                texts[suffix] = file.read()
        cases.append({
            **plain(pose), "texts": texts, "opencv": opencv,
            "rtk": {"image_px": (homogeneous[:, :2] / homogeneous[:, 2:]).tolist(),
                    "source_mm": list(geometry.GetSourcePosition(0))[:3]},
            "itk": {"class": transform.GetNameOfClass(),
                    "mapped_mm": [list(transform.TransformPoint(p.tolist())) for p in PHANTOM]},
            "deepdrr": {"image_px": np.array(index, dtype=float).tolist(),
                        "size_px": [projection.sensor_width, projection.sensor_height]},
        })
    save(out, "read_by_tools.json", {
        "tool": f"opencv-python-headless {cv2.__version__}, itk-rtk 2.7.0.post1, itk {itk.Version.GetITKVersion()}, killeengeo 0.0.5",
        "lines": "make.py read: the texts were written by sidecarm pose convert, all other numbers by the tools that read them",
    }, {"cases": cases})


if __name__ == "__main__":
    {"tools": make, "read": read}[sys.argv[1]](*sys.argv[2:])
