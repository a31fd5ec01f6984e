//! The program that stands beside the running one, or on PATH.

use std::path::{Path, PathBuf};
use std::time::Duration;

/// By how much older that program may be: one command builds both.
const AS_OLD: Duration = Duration::from_secs(600);

/// Finds a program by its name without extension, and warns if it was built long before the running one.
pub fn companion(name: &str) -> Option<PathBuf> {
    let file = format!("{name}{}", std::env::consts::EXE_SUFFIX);
    let this = std::env::current_exe().ok();
    let beside = this.as_ref().and_then(|this| Some(this.parent()?.join(&file)));
    let path = std::env::var_os("PATH").unwrap_or_default();
    let on_path = std::env::split_paths(&path).map(|folder| folder.join(&file));
    let found = beside.into_iter().chain(on_path).find(|program| program.is_file())?;
    if let Some(text) = this.and_then(|this| older(&found, &this)) {
        eprintln!("warning: {text}");
    }
    Some(found)
}

/// What to say if one program was built long before another: it may lack changes that the other has.
fn older(program: &Path, this: &Path) -> Option<String> {
    let written = |path: &Path| path.metadata().and_then(|file| file.modified()).ok();
    let age = written(this)?.duration_since(written(program)?).ok().filter(|age| *age > AS_OLD)?;
    Some(format!(
        "{} was built {} minutes before {}: it lacks what was changed in between, so its results may differ; build or install \
         it again",
        program.display(),
        age.as_secs() / 60,
        this.display()
    ))
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn a_program_that_was_built_long_before_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        let written = |name: &str, seconds: u64| {
            let path = folder.path().join(name);
            File::create(&path).unwrap().set_modified(now - Duration::from_secs(seconds)).unwrap();
            path
        };
        let [new, beside, old] = [("new", 0), ("beside", 500), ("old", 7200)].map(|(n, s)| written(n, s));
        let text = older(&old, &new).unwrap();
        assert!(text.contains("old was built 120 minutes before"), "{text}");
        assert_eq!(older(&beside, &new), None, "one command builds both");
        assert_eq!(older(&new, &old), None, "a newer one has all changes");
    }
}
