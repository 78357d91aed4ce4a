//! What a person can do about an error; said once, here at the edge.

use std::error::Error;

/// Advice about `error` or one of its causes.
#[must_use]
pub fn hint(error: &(dyn Error + 'static)) -> Option<String> {
    let mut cause = Some(error);
    while let Some(current) = cause {
        if let Some(found) = known(current) {
            return Some(found);
        }
        cause = current.source();
    }
    None
}

fn known(error: &(dyn Error + 'static)) -> Option<String> {
    if let Some(port) = error.downcast_ref::<crate::telemetry::PortError>() {
        return Some(crate::telemetry::hint(port).to_owned());
    }
    let io = error.downcast_ref::<std::io::Error>()?;
    let words = match io.kind() {
        std::io::ErrorKind::NotFound => "check the path; relative paths start at the current folder",
        std::io::ErrorKind::PermissionDenied => "check who owns the file or folder, and its permissions",
        std::io::ErrorKind::StorageFull => "free disk space; what was recorded before stays readable",
        _ => return None,
    };
    Some(words.to_owned())
}
