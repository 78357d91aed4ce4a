//! Surfaces are foreign files: a helper process decodes them, and what it hands over is checked here. So are volumes ([`super::volumes`]).

use std::io::{BufRead, Read, Seek, Write};
use std::path::Path;

use super::{SceneError, volumes};
use crate::foreign::{self, ForeignFault, Kind, Limits, Message, OpenFault, OpenFile, Receiver, Request, Sender, WireError};

/// A triangle: three corners of three coordinates, mm.
pub type Triangle = [[f32; 3]; 3];

/// All triangles of an STL file (binary or ASCII), as they stand there.
///
/// # Errors
/// When the file cannot be read or is damaged.
pub fn read_triangles(path: &Path) -> Result<Vec<Triangle>, SceneError> {
    let wrong = |detail: String| SceneError::Mesh { path: path.to_owned(), detail };
    let reader = foreign::installed();
    let limits = reader.limits(Kind::Mesh);
    let open = open(path, &limits, &wrong)?;
    let numbers = match reader.helpers() {
        Some(helpers) => {
            let request = Request { kind: Kind::Mesh, limits: limits.clone(), detail: serde_json::Value::Null };
            let most = limits.file_pixels as usize * 9;
            helpers
                .run(&request, open.file, move |messages| receive_mesh(messages, most))
                .map_err(|fault: ForeignFault| wrong(fault.to_string()))?
        }
        None => {
            let mut numbers = Vec::new();
            decode_mesh(open.file, &limits, &mut |triangle| {
                numbers.extend_from_slice(triangle.as_flattened());
                Ok(())
            })
            .map(|()| numbers)
        }
    };
    let triangle = |nine: &[f32]| [[nine[0], nine[1], nine[2]], [nine[3], nine[4], nine[5]], [nine[6], nine[7], nine[8]]];
    Ok(numbers.map_err(wrong)?.chunks_exact(9).map(triangle).collect())
}

fn open(path: &Path, limits: &Limits, wrong: &dyn Fn(String) -> SceneError) -> Result<OpenFile, SceneError> {
    foreign::open_regular(path, limits.file_bytes).map_err(|fault| match fault {
        OpenFault::Io(source) => SceneError::Io { path: path.to_owned(), source },
        other => wrong(other.to_string()),
    })
}

fn decode_mesh(
    file: std::fs::File,
    limits: &Limits,
    take: &mut dyn FnMut(&Triangle) -> Result<(), String>,
) -> Result<(), String> {
    let damaged = |error: std::io::Error| match error.kind() {
        std::io::ErrorKind::UnexpectedEof => "not a readable STL (it ends too early); export it again".to_owned(),
        _ => format!("not a readable STL ({error})"),
    };
    let length = file.metadata().map_err(damaged)?.len();
    let mut reader = std::io::BufReader::new(file);
    let mut count = 0u64;
    let mut solid = |mut reader: &mut dyn ReadSeek| {
        for triangle in stl_io::create_stl_reader(&mut reader).map_err(damaged)? {
            count += 1;
            if count > limits.file_pixels {
                return Err(format!("more than {} triangles; simplify it", limits.file_pixels));
            }
            take(&triangle.map_err(damaged)?.vertices.map(|vertex| vertex.0))?;
        }
        Ok(())
    };
    let mut head = Vec::new();
    let read = reader.by_ref().take(STL_HEAD).read_to_end(&mut head).map_err(damaged)? as u64;
    head.resize(STL_HEAD as usize, 0);
    reader.rewind().map_err(damaged)?;
    let triangles = u32::from_le_bytes([head[80], head[81], head[82], head[83]]);
    let binary_length = STL_HEAD + STL_TRIANGLE * u64::from(triangles);
    let is_text = head[..5].eq_ignore_ascii_case(b"solid") && !(read == STL_HEAD && length == binary_length);
    if !is_text {
        if length >= binary_length + STL_TRIANGLE {
            let more = length - binary_length;
            return Err(format!("says that it holds {triangles} triangles, but {more} bytes follow them; export it again"));
        }
        if u64::from(triangles) <= limits.file_pixels && head[..5].eq_ignore_ascii_case(b"solid") {
            // The reader takes the word for that of a text.
            let mut bytes = Vec::new();
            reader.read_to_end(&mut bytes).map_err(damaged)?;
            bytes[..5].fill(b' ');
            return solid(&mut std::io::Cursor::new(bytes));
        }
        return solid(&mut reader);
    }
    // A file may hold several solids, one after the other.
    let (mut text, mut line) = (Vec::new(), Vec::new());
    while reader.read_until(b'\n', &mut line).map_err(damaged)? > 0 {
        text.append(&mut line.to_ascii_lowercase());
        let ends = line.trim_ascii_start().get(..8).is_some_and(|word| word.eq_ignore_ascii_case(b"endsolid"));
        line.clear();
        if ends {
            solid(&mut std::io::Cursor::new(std::mem::take(&mut text)))?;
        }
    }
    if text.trim_ascii().is_empty() { Ok(()) } else { Err("ends before its last solid does: cut off?".into()) }
}

/// Bytes before the triangles of a binary STL, the last four their number; and those of each triangle.
const STL_HEAD: u64 = 84;
const STL_TRIANGLE: u64 = 50;

trait ReadSeek: Read + Seek {}
impl<T: Read + Seek> ReadSeek for T {}

/// The helper's work on volumes and meshes: header and numbers from `file` to `out`, then whether all went well.
///
/// # Errors
/// When the parent has gone.
pub fn serve(request: &Request, file: std::fs::File, out: impl Write) -> std::io::Result<()> {
    if request.kind != Kind::Mesh {
        return volumes::serve(request, file, out);
    }
    let (mut sender, mut gone) = (Sender::new(out), None);
    let mut send = |block: &[f32]| {
        sender.numbers(block).map_err(|error| {
            gone = Some(error);
            String::new()
        })
    };
    let mut block: Vec<f32> = Vec::new();
    let decoded = decode_mesh(file, &request.limits, &mut |triangle| {
        block.extend_from_slice(triangle.as_flattened());
        if block.len() < 1 << 16 {
            return Ok(());
        }
        let outcome = send(&block);
        block.clear();
        outcome
    });
    let end = decoded.and_then(|()| send(&block));
    match gone {
        Some(error) => Err(error),
        None => sender.end(&end),
    }
}

fn receive_mesh(messages: &mut Receiver<impl Read>, most: usize) -> Result<Result<Vec<f32>, String>, WireError> {
    let mut numbers = Vec::new();
    loop {
        match messages.receive()? {
            Message::Json(_) => return Err(WireError::Garbled("a header")),
            Message::Numbers(bytes) => Message::append(bytes, &mut numbers, most)?,
            Message::End(bytes) => {
                let end: Result<(), String> = serde_json::from_slice(bytes).map_err(|_| WireError::Garbled("not an outcome"))?;
                return Ok(end.map(|()| numbers));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangles of a file of these bytes, or why it is refused.
    fn triangles(bytes: &[u8]) -> Result<usize, String> {
        let mut file = tempfile::tempfile().expect("a temporary file");
        file.write_all(bytes).and_then(|()| file.rewind()).expect("writes");
        let mut count = 0;
        decode_mesh(file, &Limits::of(Kind::Mesh), &mut |_| {
            count += 1;
            Ok(())
        })?;
        Ok(count)
    }

    fn text(name: &str) -> String {
        let corners = "vertex 0 0 0\n vertex 1 0 0\n vertex 0 1 1.5E+0\n";
        format!("solid {name}\n facet normal 0 0 1\n outer loop\n {corners} endloop\n endfacet\nendsolid {name}\n")
    }

    #[test]
    fn every_solid_of_a_text_is_read_and_one_that_is_cut_off_is_refused() {
        let two = text("guide") + &text("sleeve");
        assert_eq!(triangles(text("one").as_bytes()), Ok(1));
        assert_eq!(triangles(two.as_bytes()), Ok(2));
        assert_eq!(triangles(two.to_ascii_uppercase().as_bytes()), Ok(2));
        assert_eq!(triangles((two.clone() + "\n \n").as_bytes()), Ok(2));
        let cut = &two[..two.len() - 30];
        assert!(triangles(cut.as_bytes()).expect_err("cut off").contains("cut off"));
    }

    #[test]
    fn a_binary_file_with_more_than_it_says_is_refused() {
        let binary = |says: u32, holds: usize| {
            let mut bytes = vec![0u8; 80];
            bytes.extend(says.to_le_bytes());
            bytes.extend(std::iter::repeat_n([0u8; 50], holds).flatten());
            bytes
        };
        assert_eq!(triangles(&binary(3, 3)), Ok(3));
        assert!(triangles(&binary(2, 3)).expect_err("one more").contains("2 triangles, but 50 bytes follow"));
        assert!(triangles(&binary(4, 3)).expect_err("one less").contains("it ends too early"));
        // Some programs begin the header of a binary file with the word of a text.
        let mut named = binary(3, 3);
        named[..11].copy_from_slice(b"solid robot");
        assert_eq!(triangles(&named), Ok(3));
    }
}
