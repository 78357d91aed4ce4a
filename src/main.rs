//! The `sidecarm` program: everything is in the library.

fn main() -> std::process::ExitCode {
    sidecarm::cli::main()
}
