//! Why an object cannot be learnt from photographs.

use std::path::PathBuf;

use sixfold_board::BoardError;
use sixfold_estimator::StoreError;
use sixfold_grasp::ViewError;
use sixfold_io::ImageFileError;
use sixfold_nn::keypoints::KeypointError;
use sixfold_sfm::SfmError;
use thiserror::Error;

/// Why an object cannot be learnt from photographs.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TeachError {
    /// Too few photographs.
    #[error(
        "found {found} photographs that can be used, expected at least {minimum}: take 8 to 40 from all \
         sides, the board in sight\
         {reasons}"
    )]
    TooFewPhotographs {
        /// How many can be used.
        found: usize,
        /// How many are needed.
        minimum: usize,
        /// Why the others cannot; empty or `; FILE: REASON; ...`.
        reasons: String,
    },
    /// All photographs are from one side.
    #[error(
        "all photographs are taken from within {degrees:.0} degrees: walk around the object, expected at \
         least {minimum:.0} degrees \
         between two of them"
    )]
    OneSide {
        /// The largest angle between two of them.
        degrees: f64,
        /// What is needed.
        minimum: f64,
    },
    /// No photograph shows the board.
    #[error(
        "no photograph shows a board of `sixfold board`{reasons}: lay the object on the printed board, give poses, or --no-board where its surroundings have \
         texture"
    )]
    NoBoard {
        /// Why; empty or `; FILE: REASON; ...`.
        reasons: String,
    },
    /// The camera cannot be found.
    #[error(
        "the camera cannot be found from these photographs{reasons}; calibrate it with `sixfold calibrate` and give --camera"
    )]
    Camera {
        /// Why.
        source: BoardError,
        /// Reasons of single photographs; empty or `; FILE: REASON; ...`.
        reasons: String,
    },
    /// The given camera is for another image size.
    #[error(
        "photographs have {width}x{height} pixels, the camera file is for {camera_width}x{camera_height}"
    )]
    CameraSize {
        /// Width of the photographs, pixels.
        width: usize,
        /// Height of the photographs, pixels.
        height: usize,
        /// Width of the camera's images, pixels.
        camera_width: usize,
        /// Height of the camera's images, pixels.
        camera_height: usize,
    },
    /// No photograph at all.
    #[error("there is no photograph: take 12 to 40 from all sides")]
    NoPhotographs,
    /// Photographs without a board that cannot be registered to each other.
    #[error(
        "{found} photographs show enough of the same, expected at least {minimum}: take 16 to 40 in steps \
         of at most 20 degrees around \
         the object, sharp, on a ground with much texture (newspaper, a patterned cloth) that stays in place{reasons}"
    )]
    NotTogether {
        /// How many match each other.
        found: usize,
        /// How many are needed.
        minimum: usize,
        /// Why the others do not; empty or `; FILE: REASON; ...`.
        reasons: String,
    },
    /// Photographs without a board that cannot be registered to each other, for another reason.
    #[error("poses from photographs: {0}")]
    Sfm(#[source] SfmError),
    /// Without a board the scale in metres is unknown.
    #[error(
        "photographs without a board do not determine the scale: give the length between two points that \
         you marked in \
         two or more photographs (--length 0.12 --ends PHOTOGRAPH:X,Y:X,Y), or depth images"
    )]
    NoScale,
    /// Depth images from which the scale cannot be computed.
    #[error(
        "{found} features of the photographs have a measured depth, expected at least {minimum}: check \
         --depth-scale and whether depth images are from the same viewpoints, or give --length and --ends"
    )]
    FewDepths {
        /// Number of features with a measured depth.
        found: usize,
        /// How many are needed.
        minimum: usize,
    },
    /// Marked points that give no length.
    #[error("--ends: {what}")]
    Ends {
        /// The values found and expected.
        what: String,
    },
    /// No features can be searched in an image.
    #[error("features of a photograph: {0}")]
    Features(#[source] KeypointError),
    /// There is no object on the board.
    #[error(
        "no object was found that all photographs agree on: expected one object on the board, opaque, in the same place in every \
         photograph{hint}"
    )]
    NoObject {
        /// More to try; empty or a sentence.
        hint: String,
    },
    /// Several objects.
    #[error(
        "found {found} objects, the second {percent:.0} % as large as the first: leave one, or give masks"
    )]
    SeveralObjects {
        /// Number of objects.
        found: usize,
        /// Size of the second against the first, percent.
        percent: f64,
    },
    /// A depth image from one side that does not show the object.
    #[error("depth from one side: {0}")]
    OneDepth(#[from] ViewError),
    /// One photograph without a board, with depth, of an unknown camera.
    #[error("{file}: a single photograph with depth needs its camera: give --camera")]
    NoCamera {
        /// The photograph.
        file: String,
    },
    /// One photograph without a board whose depth image shows no table.
    #[error(
        "{file}: its depth image shows no table: expected an object that stands on a plane, or give poses and masks (docs/teach.md)"
    )]
    NoTable {
        /// The photograph.
        file: String,
    },
    /// Masks of photographs contradict each other.
    #[error(
        "the masks of {contradicting} of {all} photographs contradict the others: objects that are \
         transparent or mirroring, or that moved between photographs, cannot be taught; correct the masks, \
         or give a mesh"
    )]
    Contradicting {
        /// Number of contradicting masks.
        contradicting: usize,
        /// Number of masks.
        all: usize,
    },
    /// A mask or pose for a photograph that does not exist.
    #[error("photograph {index}: there are {photographs}, numbered from 0")]
    NoPhotograph {
        /// The requested number.
        index: usize,
        /// How many there are.
        photographs: usize,
    },
    /// A mask of another size than its photograph.
    #[error(
        "mask of {name}: found {width}x{height} pixels, the photograph has {photograph_width}x{photograph_height}"
    )]
    MaskSize {
        /// The photograph.
        name: String,
        /// Width of the mask, pixels.
        width: usize,
        /// Height of the mask, pixels.
        height: usize,
        /// Width of the photograph, pixels.
        photograph_width: usize,
        /// Height of the photograph, pixels.
        photograph_height: usize,
    },
    /// A given mesh of another size than the object in the photographs.
    #[error(
        "--mesh: found a mesh of {mesh_mm:.1} mm diameter, the object in the photographs has about {found_mm:.1} mm: check the unit of the \
         mesh, the ruler, and whether it is the same object"
    )]
    MeshSize {
        /// Diameter of the mesh, millimetres.
        mesh_mm: f64,
        /// Diameter of the object in the photographs, millimetres.
        found_mm: f64,
    },
    /// A given mesh that is not the object in the photographs.
    #[error(
        "--mesh: its outlines cover the masks of the photographs to {percent:.0} % at best, expected at least 80 %: check whether it is the \
         same object, with all its parts"
    )]
    MeshDoesNotFit {
        /// Mean intersection over union, percent.
        percent: f64,
    },
    /// Marked points that give no pose.
    #[error("pose from points: {what}")]
    Pairs {
        /// The values found and expected.
        what: String,
    },
    /// A step was started before one that it needs.
    #[error("{missing} first")]
    Order {
        /// What has to be done.
        missing: &'static str,
    },
    /// Interrupted.
    #[error("interrupted; what was finished is kept")]
    Stopped,
    /// The network for masks failed.
    #[error("cannot find masks")]
    Masks(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// An image cannot be read or written.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// A file of the folder is invalid.
    #[error("{}: {what}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The object cannot be stored.
    #[error(transparent)]
    Store(#[from] StoreError),
}
