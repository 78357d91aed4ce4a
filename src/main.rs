//! The `sidecarm` program: everything is in the library.

/// Keeps the memory of one image for the next: the system's own gives it back, page by page.
#[global_allocator]
static MEMORY: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> std::process::ExitCode {
    sidecarm::cli::main()
}
