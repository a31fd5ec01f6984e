//! Explanations of file system errors for users of trainings.

use std::io;

/// The meaning of a file system error and what to do, in one clause.
pub(crate) fn explain(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            format!("{error}: free some space and try again; what was there before is unchanged")
        }
        io::ErrorKind::NotFound => format!("{error}: check the path"),
        io::ErrorKind::PermissionDenied => format!("{error}: check who may read and write there"),
        _ => error.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_explained() {
        let error = io::Error::new(io::ErrorKind::StorageFull, "no space left on device");
        assert!(explain(&error).contains("free some space"));
    }
}
