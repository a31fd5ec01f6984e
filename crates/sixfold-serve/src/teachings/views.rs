//! Teachings in the form for clients.

use serde::{Deserialize, Serialize};
use sixfold_mesh::Mesh;
use sixfold_teach::{By, Photograph, Snapshot, World};
use utoipa::ToSchema;

use super::Entry;
use super::scale::EndsBody;
use crate::app::App;
use crate::error::{Answer, Problem};
use crate::jobs::{JobState, JobView};
use crate::objects::SymmetryView;

/// A teaching.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct TeachingView {
    /// Its id.
    id: String,
    /// The name that the object will have.
    name: String,
    state: TeachingState,
    /// When it was created, seconds since 1970.
    created: f64,
    /// No search for hollows by comparing photographs.
    hull_only: bool,
    /// An object of the same name is replaced.
    replace: bool,
    /// Measured length of the ruler on the printed board, millimetres; null: 100.
    ruler: Option<f64>,
    /// The photographs show no board: poses come from the object's surroundings.
    without_board: bool,
    /// Measured length between the two points of `ends`, metres; without a board.
    length: Option<f64>,
    /// The ends of that length in photographs, by number.
    ends: Vec<EndsBody>,
    /// A mesh was given, to be aligned with the photographs.
    given_mesh: bool,
    /// The waiting or running job, otherwise the last one.
    job: Option<JobView>,
    /// Why the last job failed.
    problem: Option<Problem>,
    /// The camera with its distortion, if given or found; sizes in pixels.
    #[schema(value_type = Option<Object>)]
    camera: Option<sixfold_geometry::Camera>,
    /// Error of the tags' corners, or of the features without a board, pixels, once poses are found.
    rms: Option<f64>,
    /// Height of the plane on which the object stands, metres in the frame of the poses; null on the board, where it is 0.
    floor: Option<f64>,
    /// The sheet's least and largest coordinates on the board, metres, once it is found.
    board: Option<[[f64; 2]; 2]>,
    photographs: Vec<PhotographView>,
    mesh: Option<MeshView>,
    /// Symmetries of the mesh: those that are certain are stored with the object.
    symmetries: Vec<SymmetryView>,
    /// The object that was last stored from it.
    object: Option<String>,
    links: TeachingLinks,
}

/// State of a teaching.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum TeachingState {
    /// It has photographs that were not processed, or corrections whose dependent results must be computed again.
    Ready,
    /// A job waits for a worker.
    Queued,
    /// A job works on it.
    Running,
    /// The last job failed.
    Failed,
    /// The mesh is made, to be inspected and accepted.
    Taught,
    /// The object is stored.
    Accepted,
}

/// A photograph of a teaching.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct PhotographView {
    number: usize,
    /// What the client called its file.
    name: String,
    /// Pixels.
    width: Option<usize>,
    height: Option<usize>,
    state: PhotographState,
    /// Why it is left out.
    reason: Option<String>,
    has_depth: bool,
    /// Pose of the board in the camera's frame, 4x4 row by row, metres.
    camera_from_board: Option<[[f64; 4]; 4]>,
    /// Who gave the pose: program or person.
    #[schema(value_type = Option<String>)]
    pose_by: Option<By>,
    /// Who gave the mask: program or person.
    #[schema(value_type = Option<String>)]
    mask_by: Option<By>,
    links: PhotographLinks,
}

/// Whether a photograph is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum PhotographState {
    /// It is used: its pose and mask are known, or will be searched for.
    Used,
    /// It has not been processed yet.
    Waiting,
    /// The program cannot use it.
    LeftOut,
    /// A person left it out.
    LeftOutByPerson,
}

/// Links of a photograph. Add `&side=N` for images of at most N pixels (default: 1280), `&as_taken=true` to the image for one with lens
/// distortion.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct PhotographLinks {
    /// Itself without lens distortion.
    image: String,
    /// The same with the border of the mask in yellow and the outline of the mesh in blue.
    overlay: String,
    /// The mask, where there is one.
    mask: Option<String>,
}

/// Properties of the mesh.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct MeshView {
    #[serde(flatten)]
    facts: MeshFacts,
    /// False if it does not include later corrections: run the teaching.
    is_current: bool,
    /// Pose of the object in the board's frame, 4x4 row by row, metres.
    board_from_object: [[f64; 4]; 4],
    /// Fraction of the surface that no photograph shows.
    unseen: f64,
    /// Fraction of the object's pixels with depth, measured or by comparison of photographs.
    with_depth: f64,
    /// The mesh as PLY, metres; add `&faces=N` for a coarser one.
    link: String,
}

/// Numbers of a mesh.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub(crate) struct MeshFacts {
    vertices: usize,
    faces: usize,
    /// Metres.
    diameter: f64,
    /// Of its box, metres.
    size: [f64; 3],
}

impl MeshFacts {
    pub fn of(mesh: &Mesh) -> MeshFacts {
        let (low, high) = mesh.bounding_box();
        MeshFacts {
            vertices: mesh.vertices().len(),
            faces: mesh.faces().len(),
            diameter: mesh.diameter(),
            size: (high - low).into(),
        }
    }
}

/// Links of a teaching.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct TeachingLinks {
    /// The teaching itself.
    teaching: String,
    /// POST: computes what is missing, as a job.
    run: String,
    /// POST: stores the object, as a job.
    accept: String,
    /// POST: more photographs.
    photographs: String,
    /// The stored object.
    object: Option<String>,
}

impl TeachingView {
    pub fn of(app: &App, entry: &Entry) -> Answer<TeachingView> {
        // Read the job first, so that the results of a job that finishes meanwhile are included.
        let job = entry.last_job(app);
        let (record, known) = (entry.record(), entry.snapshot()?);
        let state = match job.as_ref().map(|job| job.state()) {
            Some(JobState::Queued) => TeachingState::Queued,
            Some(JobState::Running) => TeachingState::Running,
            _ if record.problem.is_some() => TeachingState::Failed,
            _ if record.accepted => TeachingState::Accepted,
            _ if known.shape().is_some() => TeachingState::Taught,
            _ => TeachingState::Ready,
        };
        let path = format!("/v1/teachings/{}", entry.id);
        let mesh = record.mesh.clone().zip(known.last_shape()).map(|(facts, shape)| MeshView {
            facts,
            is_current: known.shape().is_some(),
            board_from_object: shape.board_from_object,
            unseen: shape.unseen,
            with_depth: shape.with_depth,
            link: format!("{path}/mesh.ply?revision={}", known.revision()),
        });
        let photograph = |(number, p)| PhotographView::of(&path, &known, number, p);
        Ok(TeachingView {
            id: entry.id.clone(),
            state,
            created: record.created,
            hull_only: record.hull_only,
            replace: record.replace,
            ruler: known.options().ruler.map(|m| 1000.0 * m),
            without_board: known.options().world == World::Features,
            length: known.length().map(|length| length.metres),
            ends: known.length().map(EndsBody::all).unwrap_or_default(),
            given_mesh: known.has_given_mesh(),
            job: job.map(|job| JobView::of(app, &job)),
            problem: record.problem,
            camera: known.camera().copied().or(known.options().camera),
            rms: known.rms(),
            floor: known.floor().map(|plane| plane.offset),
            board: known.board().map(|b| b.extent().map(|corner| [corner.x, corner.y])),
            photographs: known.photographs().iter().enumerate().map(photograph).collect(),
            mesh,
            symmetries: record.symmetries,
            links: TeachingLinks {
                run: format!("{path}/run"),
                accept: format!("{path}/accept"),
                photographs: format!("{path}/photographs"),
                object: record.object.as_ref().map(|name| format!("/v1/objects/{name}")),
                teaching: path,
            },
            name: record.name,
            object: record.object,
        })
    }
}

impl PhotographView {
    fn of(teaching: &str, known: &Snapshot, number: usize, p: &Photograph) -> PhotographView {
        let state = if p.left_out_by_person {
            PhotographState::LeftOutByPerson
        } else if p.left_out.is_some() {
            PhotographState::LeftOut
        } else if known.camera().is_none() {
            PhotographState::Waiting
        } else {
            PhotographState::Used
        };
        let path = format!("{teaching}/photographs/{number}");
        let query = format!("revision={}", known.revision());
        PhotographView {
            number,
            name: p.name.clone(),
            width: p.size.map(|s| s.0),
            height: p.size.map(|s| s.1),
            state,
            reason: p.left_out.clone(),
            has_depth: p.depth.is_some(),
            camera_from_board: p.camera_from_board,
            pose_by: p.pose_by,
            mask_by: p.mask_by,
            links: PhotographLinks {
                image: format!("{path}/image.jpg?{query}"),
                overlay: format!("{path}/overlay.jpg?{query}"),
                mask: p.mask_by.map(|_| format!("{path}/mask.png?{query}")),
            },
        }
    }
}

/// A teaching in a list.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct TeachingItem {
    id: String,
    name: String,
    state: TeachingState,
    created: f64,
    photographs: usize,
    link: String,
}

impl TeachingItem {
    /// `None` for one that cannot be read.
    pub fn of(app: &App, entry: &Entry) -> Option<TeachingItem> {
        let view = TeachingView::of(app, entry).ok()?;
        Some(TeachingItem {
            id: view.id,
            name: view.name,
            state: view.state,
            created: view.created,
            photographs: view.photographs.len(),
            link: view.links.teaching,
        })
    }
}
