//! Keeps libraries under the program from talking to its user.

/// Where there is no folder for sessions (a service, a container, `su`), the Vulkan layer of Mesa that sorts devices makes Wayland's library
/// complain on standard error whenever devices are listed. Neither is needed here; the layer looks into the environment, which only a new
/// program can have another of: this one begins once more, as the same process. Where that fails, the line stands.
#[cfg(target_os = "linux")]
pub(super) fn begin_without_device_layer() {
    use std::os::unix::process::CommandExt;
    const LAYER_OFF: &str = "NODEVICE_SELECT";
    let unset = |name: &str| std::env::var_os(name).is_none();
    if !unset("XDG_RUNTIME_DIR") || !unset(LAYER_OFF) {
        return;
    }
    if let Ok(program) = std::env::current_exe() {
        let mut args = std::env::args_os();
        let mut again = std::process::Command::new(program);
        again.arg0(args.next().unwrap_or_else(|| "sidecarm".into()));
        let _error = again.args(args).env(LAYER_OFF, "1").exec();
    }
}

/// Elsewhere there is no such layer.
#[cfg(not(target_os = "linux"))]
pub(super) fn begin_without_device_layer() {}
