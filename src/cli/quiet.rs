//! Keeps libraries under the program from talking to its user.

/// Where there is no folder for sessions (a service, a container, `su`), the Vulkan layer of Mesa that sorts devices makes Wayland's library
/// complain on standard error whenever devices are listed. Neither is needed here; the layer looks into the environment, which only a new
/// program can have another of: this one begins once more, as the same process. Where that fails, the line stands.
#[cfg(target_os = "linux")]
pub(super) fn begin_without_device_layer() {
    use std::os::unix::process::CommandExt;
    const LAYER_OFF: &str = "NODEVICE_SELECT";
    /// A name that holds even when the program's file is replaced.
    const PROGRAM: &str = "/proc/self/exe";
    // Whoever chooses a device by this layer has it.
    let is_set = |name: &&str| std::env::var_os(name).is_some();
    let is_asked_for = ["XDG_RUNTIME_DIR", LAYER_OFF, "MESA_VK_DEVICE_SELECT", "DRI_PRIME"].iter().any(is_set);
    if is_asked_for || !std::path::Path::new(PROGRAM).exists() {
        return;
    }
    let mut args = std::env::args_os();
    let mut again = std::process::Command::new(PROGRAM);
    again.arg0(args.next().unwrap_or_else(|| "sidecarm".into()));
    let _error = again.args(args).env(LAYER_OFF, "1").exec();
}

/// Elsewhere there is no such layer.
#[cfg(not(target_os = "linux"))]
pub(super) fn begin_without_device_layer() {}
