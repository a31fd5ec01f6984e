//! Template matching as a [`PoseEstimator`].

use std::collections::BTreeMap;
use std::sync::Arc;

use serde_json::{Map, Value, json};
use sixfold_align::{DepthOptions, VerificationMesh};
use sixfold_estimator::{
    EstimatorError, MinConfidence, Need, Needs, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
    downcast,
};
use sixfold_io::fnv1a;
use sixfold_mesh::Mesh;

use crate::error::StoreError;
use crate::estimate::{KnownObject, MttmEstimate, MttmOptions, Stages, search};
use crate::regions::RegionCache;
use crate::template::{ObjectTemplates, Source, TemplateOptions};
use crate::views::ViewCoverage;

const METHOD: &str = "mttm";
/// File of an object's templates in its folder.
pub const TEMPLATES_FILE: &str = "templates.bin";
/// File of the mesh that verification renders.
const MESH_FILE: &str = "verification-mesh.bin";

/// Objects never trained on, found in depth by their templates (dissertation, chapter 5).
#[derive(Debug, Clone, Default)]
pub struct MttmEstimator {
    /// How depth images are prepared.
    pub depth: DepthOptions,
    /// Options of the search; the query sets the number of instances and the minimum confidence.
    pub options: MttmOptions,
    /// Which templates are rendered from a mesh if the object's folder has none yet.
    pub templates: TemplateOptions,
    /// From which sides an object with a mesh is searched, whatever templates its folder has; these templates are kept in files of
    /// their own. `None`: the templates in its folder, or those rendered with the field `templates`.
    pub coverage: Option<ViewCoverage>,
    /// Templates by object id that are used instead of all others, such as those from a dataset's own depth images; then an object
    /// that has none here is refused. Empty: not used.
    pub given: Arc<BTreeMap<u32, ObjectTemplates>>,
    /// The network (feature `network`); without one, matching is by points alone.
    #[cfg(feature = "network")]
    pub network: Option<Arc<crate::model::MttmModel>>,
    /// Verify poses with the matched templates only, as if there were no mesh.
    pub templates_only: bool,
}

/// An object prepared for template matching.
pub struct MttmObject {
    name: String,
    mesh: Option<Arc<Mesh>>,
    object: KnownObject,
    notes: Vec<String>,
}

impl MttmObject {
    /// Its templates, ready to be searched.
    pub fn known(&self) -> &KnownObject {
        &self.object
    }
}

impl PreparedObject for MttmObject {
    fn name(&self) -> &str {
        &self.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        self.mesh.as_deref()
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl MttmEstimator {
    /// The name of a file derived from an object's templates.
    pub(crate) fn file_name(&self, what: &str) -> String {
        match self.coverage {
            None => format!("{what}.bin"),
            Some(coverage) => format!("{what}-{}.bin", coverage.name()),
        }
    }

    /// The object's templates of [`MttmEstimator::given`].
    fn given(&self, object: &Object) -> Result<ObjectTemplates, EstimatorError> {
        let given = object.id.and_then(|id| self.given.get(&id));
        given.cloned().ok_or_else(|| EstimatorError::Lacks {
            object: object.name.clone(),
            what: "template among those given",
            method: METHOD,
            advice: "give templates of this object too, or do not look for it",
        })
    }

    /// The object's templates: those in its folder, or rendered from its mesh with [`MttmEstimator::templates`] and
    /// [`MttmEstimator::coverage`].
    fn templates(&self, object: &Object, notes: &mut Vec<String>) -> Result<ObjectTemplates, EstimatorError> {
        let wrap = |source| EstimatorError::Object { object: object.name.clone(), source };
        let file = object.file(TEMPLATES_FILE);
        let Some(mesh) = &object.mesh else {
            let file = file.ok_or_else(|| EstimatorError::Lacks {
                object: object.name.clone(),
                what: "mesh and no templates",
                method: METHOD,
                advice: "add it with `sixfold object add`",
            })?;
            let only =
                |source| StoreError::OnlyTemplates { object: object.name.clone(), source: Box::new(source) };
            if let Some(coverage) = self.coverage {
                notes.push(format!(
                    "templates {} of {}: it is known from depth images alone, so it is found from their sides",
                    coverage.name(),
                    object.name
                ));
            }
            return ObjectTemplates::read(&file).map_err(|e| wrap(Box::new(only(e))));
        };
        let wanted =
            TemplateOptions { coverage: self.coverage.unwrap_or(self.templates.coverage), ..self.templates };
        let Some(file) = object.file(&self.file_name("templates")) else {
            return ObjectTemplates::from_mesh(mesh, &wanted).map_err(|e| wrap(Box::new(e)));
        };
        // Templates that were requested with other views are left as they are.
        let options = match self.coverage {
            None => ObjectTemplates::read(&file).map_or(wanted, |kept| kept.options),
            Some(_) => wanted,
        };
        let (templates, note) =
            ObjectTemplates::cached(&file, mesh, &options).map_err(|e| wrap(Box::new(e)))?;
        notes.extend(note.map(|n| format!("templates of {} not kept, or computed again: {n}", object.name)));
        Ok(templates)
    }
}

impl PoseEstimator for MttmEstimator {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        Needs { depth: Need::Required, rgb: Need::Unused, region: Need::Optional, object: Need::Required }
    }

    fn depth_options(&self) -> DepthOptions {
        self.depth
    }

    fn held(&self, id: u32) -> Option<(&'static str, u64)> {
        self.given.get(&id).map(|templates| ("set of given templates", fnv1a(&templates.to_bytes())))
    }

    /// Right poses in real frames have confidences of 0.36 to 0.73, wrong ones up to 0.54 (LM-O frame 3, by `cargo test --release
    /// -p sixfold-mttm --test real_frames -- --nocapture`).
    fn min_confidence(&self) -> MinConfidence {
        MinConfidence { image: 0.45, dataset: MttmOptions::default().min_score }
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let mut notes = vec![];
        let (templates, described) = if self.given.is_empty() {
            (self.templates(object, &mut notes)?, object.clone())
        } else {
            // Descriptors in the object's folder are those of its own templates.
            (self.given(object)?, Object { folder: None, ..object.clone() })
        };
        let mut rendered = None;
        if let Some(mesh) = object.mesh.as_ref().filter(|_| !self.templates_only) {
            let kept = VerificationMesh::cached(object.file(MESH_FILE).as_deref(), mesh);
            let wrap = |e| EstimatorError::Object { object: object.name.clone(), source: Box::new(e) };
            let kept = kept.map_err(wrap)?;
            notes.extend(
                kept.note.map(|n| format!("mesh of {} not kept, or simplified again: {n}", object.name)),
            );
            rendered = Some(kept.mesh);
        }
        let known = self.described(KnownObject::new(templates, rendered), &described, &mut notes);
        Ok(Box::new(MttmObject {
            name: object.name.clone(),
            mesh: object.mesh.clone(),
            object: known,
            notes,
        }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &MttmObject = downcast(object, METHOD)?;
        let options = MttmOptions {
            max_instances: query.max_instances,
            min_score: query.min_confidence,
            ..self.options.for_templates(object.object.templates())
        };
        options.check().map_err(EstimatorError::method)?;
        let regions = query.memo.get_or_default::<RegionCache>();
        let (found, stages) = search(query.depth_region(METHOD)?, &regions, &object.object, &options);
        let pose = |e: MttmEstimate| PoseEstimate {
            verification: Some(e.score),
            details: details(&object.object, &e, &stages),
            mask: Some(e.mask),
            ..PoseEstimate::new(e.camera_from_object, e.confidence)
        };
        Ok(found.into_iter().map(pose).collect())
    }
}

/// Details of an estimate: the matched template (counted from 0; for views without poses the pose is that of this view's frame),
/// whether the pose is that of the object's frame (a mesh, or views with poses) or only of the matched view's, how it was verified,
/// and the run time of each stage.
fn details(object: &KnownObject, e: &MttmEstimate, stages: &Stages) -> Map<String, Value> {
    let of_view = object.templates().source == Source::Depth;
    Map::from_iter([
        ("template".to_owned(), e.template.into()),
        ("frame".to_owned(), if of_view { "view" } else { "object" }.into()),
        ("verified_by".to_owned(), if object.has_mesh() { "mesh" } else { "template" }.into()),
        ("mask_pixels".to_owned(), e.mask.len().into()),
        ("seconds".to_owned(), json!(stages)),
    ])
}
