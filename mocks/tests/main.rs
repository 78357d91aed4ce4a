//! The mocks from outside: ports, faults, a whole session, the kit. The receiver here is written anew from `PROTOCOL.md`.

mod kit;
mod line;
mod receiver;
mod session;

/// An empty folder of its own.
fn folder(name: &str) -> std::path::PathBuf {
    let path = std::env::temp_dir().join(format!("mock-lab-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir_all(&path).expect("temporary folder");
    path
}
