//! The location of the weights and samples that come with Sixfold as separate files: in a checkout, beside an installed program,
//! or in the user's data folder (XDG Base Directory Specification 0.8). docs/install.md lists the places.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

/// The environment variable that names the only folder to search.
pub const VARIABLE: &str = "SIXFOLD_SHARE";

/// A file or folder that comes with Sixfold.
#[derive(Debug, Clone, Copy)]
pub struct Shipped {
    /// Its description, for messages.
    what: &'static str,
    /// Its path in a folder of shipped files.
    name: &'static str,
    /// Its path in a checkout.
    checkout: &'static str,
    /// A file that identifies the folder; empty for a file.
    sign: &'static str,
    /// The option that names another one.
    option: &'static str,
}

/// The sample frames of LM-O.
pub const DEMO: Shipped = Shipped {
    what: "the sample data",
    name: "demo",
    checkout: "data/demo",
    sign: "test_targets_bop19.json",
    option: "--data DIR",
};

/// Weights of Pix2Pose for the samples' objects.
pub const PIX2POSE: Shipped = Shipped::weights("weights/pix2pose-lmo.safetensors", "--weights FILE");

/// Weights of the detector for the samples' objects.
pub const DETECTOR: Shipped = Shipped::weights("weights/detector-lmo.safetensors", "--detector FILE");

/// The network that finds grasps from experience.
pub const DGCM: Shipped = Shipped::weights("weights/dgcm.safetensors", "--weights FILE");

impl Shipped {
    const fn weights(name: &'static str, option: &'static str) -> Shipped {
        Shipped { what: "the file of weights", name, checkout: name, sign: "", option }
    }

    /// Its path.
    ///
    /// # Errors
    ///
    /// Names every place that was searched and what to do.
    pub fn find(&self) -> Result<PathBuf> {
        self.find_in(&Places::of_this_process())
    }

    fn find_in(&self, places: &Places) -> Result<PathBuf> {
        let candidates = self.candidates(places);
        if let Some(path) = candidates.iter().find(|path| self.is_at(path)) {
            return Ok(path.canonicalize().unwrap_or_else(|_| path.clone()));
        }
        let searched: Vec<String> = candidates.iter().map(|path| path.display().to_string()).collect();
        let install = match (&places.variable, &places.user) {
            (Some(_), _) => format!("let {VARIABLE} name a folder that has {}, or unset it", self.name),
            (None, Some(user)) => format!(
                "copy the folders data/demo and weights of Sixfold's repository into {}, or let {VARIABLE} name a folder that has them",
                user.display()
            ),
            (None, None) => format!("let {VARIABLE} name a folder that has {}", self.name),
        };
        bail!(
            "{} ({}) is in none of these places: {}. Give {}; or {install} (docs/install.md)",
            self.what,
            self.name,
            searched.join(", "),
            self.option
        )
    }

    fn is_at(&self, path: &Path) -> bool {
        match self.sign {
            "" => path.is_file(),
            sign => path.join(sign).is_file(),
        }
    }

    /// The possible places, in order of preference. Where the variable names a folder, no other place is used.
    fn candidates(&self, places: &Places) -> Vec<PathBuf> {
        let mut candidates: Vec<PathBuf> = match &places.variable {
            Some(folder) => vec![folder.join(self.name), folder.join(self.checkout)],
            None => {
                let above =
                    places.here.iter().flat_map(|here| here.ancestors()).map(|f| f.join(self.checkout));
                let installed = places.program.iter().chain(&places.user).map(|f| f.join(self.name));
                above.chain(installed).chain(places.built.iter().map(|f| f.join(self.checkout))).collect()
            }
        };
        let mut seen = std::collections::BTreeSet::new();
        candidates.retain(|path| seen.insert(path.clone()));
        candidates
    }
}

/// The folders to search.
#[derive(Debug, Default)]
struct Places {
    /// The folder that the variable names.
    variable: Option<PathBuf>,
    /// The current folder: it, or one above, may be a checkout.
    here: Option<PathBuf>,
    /// `share/sixfold` beside the folder of the program.
    program: Option<PathBuf>,
    /// `sixfold` in the user's data folder.
    user: Option<PathBuf>,
    /// The checkout that the program was built in.
    built: Option<PathBuf>,
}

impl Places {
    fn of_this_process() -> Places {
        let absolute =
            |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let program = std::env::current_exe().ok().map(|me| me.canonicalize().unwrap_or(me));
        let data =
            absolute("XDG_DATA_HOME").or_else(|| absolute("HOME").map(|home| home.join(".local/share")));
        Places {
            variable: std::env::var_os(VARIABLE).filter(|text| !text.is_empty()).map(PathBuf::from),
            here: std::env::current_dir().ok(),
            program: program.as_deref().and_then(share_of),
            user: data.map(|data| data.join("sixfold")),
            built: Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).map(Path::to_path_buf),
        }
    }
}

/// `PREFIX/share/sixfold` of a program `PREFIX/bin/sixfold`.
fn share_of(program: &Path) -> Option<PathBuf> {
    Some(program.parent()?.parent()?.join("share/sixfold"))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    /// A folder with the samples and the weights of a checkout.
    fn checkout(at: &Path) -> PathBuf {
        fs::create_dir_all(at.join("data/demo")).unwrap();
        fs::create_dir_all(at.join("weights")).unwrap();
        fs::write(at.join("data/demo").join(DEMO.sign), "[]").unwrap();
        fs::write(at.join(DGCM.checkout), "").unwrap();
        at.canonicalize().unwrap()
    }

    /// A folder with the samples and the weights as they are installed.
    fn installed(at: &Path) -> PathBuf {
        fs::create_dir_all(at.join("demo")).unwrap();
        fs::create_dir_all(at.join("weights")).unwrap();
        fs::write(at.join("demo").join(DEMO.sign), "[]").unwrap();
        fs::write(at.join(DGCM.name), "").unwrap();
        at.canonicalize().unwrap()
    }

    #[test]
    fn each_place_is_taken_when_those_before_it_are_missing() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        let above = checkout(&at("above"));
        fs::create_dir_all(above.join("deep/deeper")).unwrap();
        let mut places = Places {
            variable: Some(installed(&at("variable"))),
            here: Some(above.join("deep/deeper")),
            program: Some(installed(&at("prefix/share/sixfold"))),
            user: Some(installed(&at("user/sixfold"))),
            built: Some(checkout(&at("built"))),
        };
        let found = |places: &Places| (DEMO.find_in(places).unwrap(), DGCM.find_in(places).unwrap());
        let of = |folder: &Path, demo: &str| (folder.join(demo), folder.join("weights/dgcm.safetensors"));
        assert_eq!(found(&places), of(places.variable.as_deref().unwrap(), "demo"));
        places.variable = None;
        assert_eq!(found(&places), of(&above, "data/demo"));
        fs::remove_dir_all(above.join("data")).unwrap();
        fs::remove_dir_all(above.join("weights")).unwrap();
        assert_eq!(found(&places), of(places.program.as_deref().unwrap(), "demo"));
        fs::remove_dir_all(places.program.as_deref().unwrap()).unwrap();
        assert_eq!(found(&places), of(places.user.as_deref().unwrap(), "demo"));
        fs::remove_dir_all(places.user.as_deref().unwrap()).unwrap();
        assert_eq!(found(&places), of(places.built.as_deref().unwrap(), "data/demo"));
        fs::remove_dir_all(places.built.as_deref().unwrap()).unwrap();
        let error = DEMO.find_in(&places).unwrap_err().to_string();
        for place in [&places.here, &places.program, &places.user, &places.built] {
            assert!(error.contains(&place.as_deref().unwrap().display().to_string()), "{error}");
        }
        assert!(error.contains("--data DIR") && error.contains(VARIABLE), "{error}");
    }

    #[test]
    fn a_folder_that_the_variable_names_is_the_only_one() {
        let root = tempfile::tempdir().unwrap();
        let user = installed(&root.path().join("user/sixfold"));
        let empty = root.path().join("empty");
        let places = Places { variable: Some(empty.clone()), user: Some(user.clone()), ..Places::default() };
        let error = DGCM.find_in(&places).unwrap_err().to_string();
        assert!(error.contains(&empty.join("weights/dgcm.safetensors").display().to_string()), "{error}");
        assert!(!error.contains(&user.display().to_string()), "{error}");
        // It may be a checkout.
        let places = Places { variable: Some(checkout(&root.path().join("checkout"))), ..Places::default() };
        assert!(DEMO.find_in(&places).unwrap().ends_with("data/demo"));
    }

    #[test]
    fn another_folder_of_the_same_name_is_passed_over() {
        let root = tempfile::tempdir().unwrap();
        let user = installed(&root.path().join("user/sixfold"));
        fs::create_dir_all(root.path().join("data/demo")).unwrap();
        let places =
            Places { here: Some(root.path().to_path_buf()), user: Some(user.clone()), ..Places::default() };
        assert_eq!(DEMO.find_in(&places).unwrap(), user.join("demo"));
    }

    #[test]
    fn the_share_folder_of_a_program_is_beside_its_bin_folder() {
        let share = share_of(Path::new("/usr/local/bin/sixfold"));
        assert_eq!(share.as_deref(), Some(Path::new("/usr/local/share/sixfold")));
    }

    #[test]
    fn everything_that_is_shipped_is_in_this_checkout() {
        let built = Places::of_this_process().built.unwrap();
        if !built.join("ARCHITECTURE.md").exists() {
            println!("skipped: not a checkout");
            return;
        }
        for shipped in [DEMO, PIX2POSE, DETECTOR, DGCM] {
            assert!(shipped.is_at(&built.join(shipped.checkout)), "{}", shipped.checkout);
        }
    }
}
