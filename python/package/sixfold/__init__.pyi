from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path as PurePath
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import bop as bop
from . import coco as coco
from . import metrics as metrics

__version__: str

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Path = str | PathLike[str]
Unit = Literal["m", "mm", "cm", "in"]
Color = tuple[float, float, float] | Sequence[float]
Light: TypeAlias = "AmbientLight | DirectionalLight | PointLight"
Dicts = list[dict[str, Any]]
Texts = list[str]
View = tuple[ArrayLike, Camera, ArrayLike] | tuple[ArrayLike, Camera, ArrayLike, ArrayLike]
"""Depth, camera, mask, and the pose if it is known."""
Progress = Callable[[dict[str, Any]], object]
"""Called with stage, done, total; dataset: image; training: seconds, learning_rate, samples_per_second, losses."""
Levels = Iterable[tuple[float, int, int]]
"""Rejection distance in metres, iterations, stride."""

class NoSolutionError(ValueError): ...

class Camera:
    def __new__(
        cls,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        width: int,
        height: int,
        distortion: ArrayLike | None = None,
    ) -> Camera: ...
    @classmethod
    def load(
        cls, path: Path, width: int | None = None, height: int | None = None
    ) -> tuple[Camera, float | None]: ...
    @property
    def fx(self) -> float: ...
    @property
    def fy(self) -> float: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def distortion(self) -> tuple[float, float, float, float, float] | None: ...
    @property
    def matrix(self) -> Float: ...
    def project(self, points: ArrayLike) -> Float: ...
    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Float: ...
    def distort_points(self, pixels: ArrayLike) -> Float: ...
    def undistort_points(self, pixels: ArrayLike) -> Float: ...
    def without_distortion(self) -> Camera: ...
    def crop(self, box: ArrayLike) -> Camera: ...
    def resize(self, width: int, height: int) -> Camera: ...

class Mesh:
    def __new__(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike | None = None,
        *,
        normals: ArrayLike | None = None,
        colors: ArrayLike | None = None,
        texcoords: ArrayLike | None = None,
        texture: ArrayLike | None = None,
        symmetries: ArrayLike | None = None,
        symmetry_axes: Iterable[tuple[ArrayLike, ArrayLike]] | None = None,
    ) -> Mesh: ...
    @classmethod
    def load(
        cls, path: Path, unit: Unit, *, check_size: bool = True, allow_outside: bool = False
    ) -> Mesh: ...
    def save(self, path: Path, unit: Unit, *, binary: bool = True) -> None: ...
    @property
    def vertices(self) -> Float: ...
    @property
    def faces(self) -> NDArray[np.uint32]: ...
    @property
    def normals(self) -> Float | None: ...
    @property
    def colors(self) -> Bytes | None: ...
    @property
    def texcoords(self) -> Float32 | None: ...
    @property
    def texture(self) -> Bytes | None: ...
    @property
    def diameter(self) -> float: ...
    @property
    def symmetries(self) -> Float: ...
    @property
    def symmetry_axes(self) -> list[tuple[Float, Float]]: ...
    @property
    def bounding_box(self) -> Float: ...
    @property
    def surface_area(self) -> float: ...
    def with_symmetries(
        self, symmetries: ArrayLike | None = None, axes: Iterable[tuple[ArrayLike, ArrayLike]] | None = None
    ) -> Mesh: ...
    def vertex_normals(self) -> Float: ...
    def sample_surface(self, count: int, *, seed: int = 0) -> tuple[Float, Float, NDArray[np.uint32]]: ...
    def simplify(self, faces: int) -> Mesh: ...
    def convex_hull(self) -> Mesh: ...
    def surfels(self) -> Mesh: ...
    def transformed(self, pose: ArrayLike) -> Mesh: ...
    def scaled(self, factor: float) -> Mesh: ...
    @staticmethod
    def merged(meshes: Sequence[Mesh]) -> Mesh: ...

class AmbientLight:
    def __new__(cls, color: Color = (0.35, 0.35, 0.35)) -> AmbientLight: ...

class DirectionalLight:
    def __new__(cls, direction: ArrayLike, color: Color = (0.75, 0.75, 0.75)) -> DirectionalLight: ...

class PointLight:
    def __new__(cls, position: ArrayLike, color: Color = (0.75, 0.75, 0.75)) -> PointLight: ...

class Rendering:
    @property
    def depth(self) -> Float32: ...
    @property
    def mask(self) -> Bool: ...
    @property
    def normals(self) -> Float32: ...
    @property
    def coordinates(self) -> Float32: ...
    @property
    def rgb(self) -> Bytes: ...
    def __iter__(self) -> Iterator[NDArray[Any]]: ...
    def __len__(self) -> int: ...

class SceneRendering:
    @property
    def depth(self) -> Float32: ...
    @property
    def masks(self) -> Bool: ...
    @property
    def instances(self) -> NDArray[np.int32]: ...
    @property
    def normals(self) -> Float32: ...
    @property
    def coordinates(self) -> Float32: ...
    @property
    def rgb(self) -> Bytes: ...

def render(
    mesh: Mesh,
    camera_from_object: ArrayLike,
    camera: Camera,
    lights: Iterable[Light] | None = None,
    *,
    background: ArrayLike | None = None,
    specular: float = 0.0,
    shininess: float = 20.0,
    plain_color: Sequence[int] = (200, 200, 200),
    near: float = 0.01,
    cull_back_faces: bool = False,
) -> Rendering: ...
def render_scene(
    objects: Iterable[tuple[Mesh, ArrayLike]],
    camera: Camera,
    lights: Iterable[Light] | None = None,
    *,
    background: ArrayLike | None = None,
    specular: float = 0.0,
    shininess: float = 20.0,
    plain_color: Sequence[int] = (200, 200, 200),
    near: float = 0.01,
    cull_back_faces: bool = False,
) -> SceneRendering: ...
def render_depth(mesh: Mesh, camera_from_object: ArrayLike, camera: Camera) -> Float32: ...
def shipped(name: str) -> PurePath: ...
def simulate_depth(depth: ArrayLike, normals: ArrayLike, *, seed: int = 0) -> Float32: ...
def support_plane(objects: Iterable[tuple[Mesh, ArrayLike]]) -> Plane | None: ...
def undistort_rgb(rgb: ArrayLike, camera: Camera) -> Bytes: ...
def undistort_depth(depth: ArrayLike, camera: Camera) -> Float32: ...
def pose_exp(twist: ArrayLike) -> Float: ...
def pose_log(pose: ArrayLike) -> Float: ...

class PnpResult:
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def inliers(self) -> Bool: ...
    @property
    def inlier_count(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    @property
    def score(self) -> float: ...
    @property
    def rms_px(self) -> float: ...
    def __iter__(self) -> Iterator[NDArray[Any]]: ...
    def __len__(self) -> int: ...

def pnp_ransac(
    object_points: ArrayLike,
    image_points: ArrayLike,
    camera: Camera,
    threshold_px: float = 3.0,
    max_iterations: int = 10_000,
    seed: int = 0,
    *,
    min_iterations: int | None = None,
    confidence: float | None = None,
    solver: Literal["ap3p", "epnp"] = "ap3p",
    refine: bool = True,
) -> PnpResult: ...
def epnp(object_points: ArrayLike, image_points: ArrayLike, camera: Camera) -> Float: ...
def refine_pose(
    object_points: ArrayLike,
    image_points: ArrayLike,
    camera: Camera,
    initial: ArrayLike,
    threshold_px: float = 3.0,
    max_iterations: int = 50,
) -> tuple[Float, int]: ...
def kabsch(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> Float: ...
def umeyama(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> tuple[Float, float]: ...

class IcpResult:
    @property
    def target_from_source(self) -> Float: ...
    @property
    def rms(self) -> float: ...
    @property
    def inliers(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    @property
    def converged(self) -> bool: ...
    def __iter__(self) -> Iterator[Any]: ...
    def __len__(self) -> int: ...

def icp(
    source: ArrayLike,
    target: ArrayLike,
    target_normals: ArrayLike,
    initial: ArrayLike | None = None,
    *,
    rejection_distance: float = 0.02,
    source_normals: ArrayLike | None = None,
    levels: Levels | None = None,
    max_angle: float = ...,
) -> IcpResult: ...
def icp_to_depth(
    source: ArrayLike,
    depth: ArrayLike,
    camera: Camera,
    initial: ArrayLike,
    *,
    rejection_distance: float = 0.02,
    source_normals: ArrayLike | None = None,
    levels: Levels | None = None,
    max_angle: float = ...,
) -> IcpResult: ...

class Plane:
    @property
    def normal(self) -> Float: ...
    @property
    def offset(self) -> float: ...
    def distance(self, points: ArrayLike) -> Float: ...

def normals_from_depth(
    depth: ArrayLike, camera: Camera, *, radius: int | None = None, max_relative_step: float | None = None
) -> Float32: ...
def inpaint_depth(depth: ArrayLike, rounds: int = 2) -> Float32: ...
def point_cloud(depth: ArrayLike, camera: Camera) -> tuple[Float, Float]: ...
def voxel_downsample(
    points: ArrayLike, size: float, normals: ArrayLike | None = None, *, max_angle: float = 1.0
) -> tuple[Float, Float | None]: ...
def dominant_plane(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    threshold: float = 0.01,
    iterations: int = 300,
    min_fraction: float = 0.15,
    seed: int = 0,
) -> Plane | None: ...
def fit_plane(points: ArrayLike) -> Plane: ...
def sphere_directions(count: int) -> Float: ...

class PpfModel:
    def __new__(
        cls, mesh: Mesh, *, sampling_step: float = 0.05, angle_steps: int = 15, cache: Path | None = None
    ) -> PpfModel: ...
    @property
    def cache_note(self) -> str | None: ...
    @property
    def diameter(self) -> float: ...
    @property
    def samples(self) -> Float: ...
    @property
    def pair_count(self) -> int: ...

class PpfScene:
    def __new__(
        cls,
        depth: ArrayLike,
        camera: Camera,
        mask: ArrayLike | None = None,
        *,
        remove_plane: bool = True,
        max_depth: float = 5.0,
        seed: int = 0,
    ) -> PpfScene: ...
    @property
    def plane(self) -> Plane | None: ...
    @property
    def points(self) -> Float: ...

class PpfEstimate:
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def confidence(self) -> float: ...
    @property
    def votes(self) -> float: ...
    @property
    def verification(self) -> dict[str, float]: ...

def estimate_ppf(
    scene: PpfScene | ArrayLike,
    model: PpfModel | Mesh,
    camera: Camera | None = None,
    mask: ArrayLike | None = None,
    *,
    instances: int = 1,
    min_score: float = 0.05,
    refined: int | None = None,
    verified: int | None = None,
    seed: int = 0,
) -> list[PpfEstimate]: ...

class Estimate:
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def confidence(self) -> float: ...
    @property
    def probability(self) -> float | None: ...
    @property
    def mask(self) -> Bool | None: ...
    @property
    def details(self) -> dict[str, Any]: ...
    @property
    def notes(self) -> Texts: ...

class Estimator:
    """A pose estimation method of `sixfold estimate`. All methods have the same interface."""

    def __new__(
        cls,
        method: Literal["ppf", "mttm", "pix2pose", "views", "auto"] = "auto",
        *,
        weights: Path | None = None,
        keep_plane: bool = False,
        matcher: Literal["points", "network", "both"] = "both",
        templates_only: bool = False,
        templates: Literal["above", "around"] | None = None,
        refine: bool = True,
        passes: int | None = None,
        icp: bool = False,
        budget: float | None = None,
        seed: int = 0,
    ) -> Estimator:
        """Creates an estimator. The methods that accept each option:

        weights: pix2pose (required), mttm, views, auto.
        keep_plane: ppf, mttm, auto.
        matcher, templates_only, templates: mttm.
        refine: pix2pose, views.
        passes, icp: pix2pose.
        budget (seconds): auto.
        seed: all methods."""
    @property
    def name(self) -> str: ...
    @property
    def needs(self) -> dict[str, str]:
        """For each of depth, rgb, region and object: "required", "optional" or "unused"."""
    def find(
        self,
        object: Mesh | None,
        camera: Camera,
        depth: ArrayLike | None = None,
        rgb: ArrayLike | None = None,
        box: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        instances: int = 1,
        min_confidence: float | None = None,
        *,
        id: int | None = None,
    ) -> list[Estimate]:
        """Searches for an object in an image. Returns estimates, best first; empty if it is not found.

        id: which of the weights' objects to search for."""
    def run_dataset(
        self,
        path: Path,
        out: Path,
        split: str = "test",
        boxes: Path | None = None,
        detector: Path | None = None,
        targets: Path | None = None,
        min_confidence: float | None = None,
        *,
        cache: Path | None = None,
        progress: Progress | None = None,
    ) -> dict[str, Any]:
        """Searches for all targets of a BOP dataset and writes a result file.

        boxes: "gt" for those of the ground truth, or a file of COCO detections."""

class Pix2PosePose:
    @property
    def object_id(self) -> int: ...
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def score(self) -> float: ...
    @property
    def refined(self) -> bool: ...
    @property
    def agreement(self) -> float | None: ...
    @property
    def aligned_to_depth(self) -> bool: ...
    @property
    def hypotheses(self) -> list[dict[str, Any]]: ...
    @property
    def window(self) -> Float: ...
    @property
    def input(self) -> Bytes: ...
    @property
    def coordinates(self) -> Float32: ...
    @property
    def error(self) -> Float32: ...
    @property
    def visible(self) -> Float32: ...
    @property
    def object_points(self) -> Float: ...
    @property
    def image_points(self) -> Float: ...

class Pix2Pose:
    @classmethod
    def load(cls, path: Path, camera: Camera | None = None, meshes: Mapping[int, Mesh] | None = None) -> Pix2Pose: ...
    @property
    def objects(self) -> list[dict[str, Any]]: ...
    @property
    def card(self) -> dict[str, Any]: ...
    def __call__(
        self,
        rgb: ArrayLike,
        boxes: ArrayLike,
        object_ids: ArrayLike | None = None,
        *,
        camera: Camera | None = None,
        meshes: Mapping[int, Mesh] | None = None,
        depth: ArrayLike | None = None,
        thresholds: ArrayLike | None = None,
        two_stages: bool = True,
        refine: bool = True,
        passes: int = 1,
        correct: bool = True,
        crop_factor: float = 1.5,
        seed: int = 0,
    ) -> list[Pix2PosePose | None]: ...

class DetectedObject:
    @property
    def object_id(self) -> int: ...
    @property
    def score(self) -> float: ...
    @property
    def bbox(self) -> Float: ...
    @property
    def mask(self) -> Bool | None: ...

class Detector:
    @classmethod
    def load(cls, path: Path) -> Detector: ...
    @property
    def object_ids(self) -> list[int]: ...
    @property
    def threshold(self) -> float: ...
    @property
    def card(self) -> dict[str, Any]: ...
    def __call__(
        self,
        rgb: ArrayLike,
        *,
        object_ids: ArrayLike | None = None,
        threshold: float | None = None,
        overlap: float = 0.5,
        per_object: int = 100,
        max_detections: int = 100,
        scales: int = 1,
        masks: bool = True,
    ) -> list[DetectedObject]: ...

class ViewsDetector:
    def __init__(
        self,
        objects: Mapping[int, Mesh],
        *,
        poses: bool = True,
        masks: bool = True,
        threshold: float = 0.5,
        overlap: float = 0.5,
        per_object: int = 100,
        max_detections: int = 100,
    ) -> None: ...
    @property
    def object_ids(self) -> list[int]: ...
    def __call__(self, rgb: ArrayLike) -> list[DetectedObject]: ...

class Gripper:
    @staticmethod
    def load(path: Path) -> Gripper: ...
    @staticmethod
    def built_in(name: str) -> Gripper: ...
    @property
    def name(self) -> str: ...
    @property
    def max_opening(self) -> float: ...
    @property
    def finger_length(self) -> float: ...
    @property
    def finger_width(self) -> float: ...
    @property
    def force(self) -> float: ...
    @property
    def friction(self) -> float: ...
    def mesh(self, opening: float) -> Mesh: ...

class Grasp:
    @property
    def camera_from_gripper(self) -> Float: ...
    @property
    def opening(self) -> float: ...
    @property
    def width(self) -> float: ...
    @property
    def quality(self) -> float: ...
    @property
    def alignment(self) -> float: ...
    @property
    def support(self) -> float: ...
    @property
    def centring(self) -> float: ...
    @property
    def observed(self) -> float: ...
    @property
    def members(self) -> int: ...
    @property
    def score(self) -> float: ...
    @property
    def experience(self) -> dict[str, Any] | None: ...

def find_symmetries(mesh: Mesh, *, noise: float = 0.0, seed: int = 0) -> Dicts: ...
def find_objects(depth: ArrayLike, camera: Camera, *, seed: int = 0) -> list[Bool]: ...
def propose_grasps(
    depth: ArrayLike,
    camera: Camera,
    mask: ArrayLike | None = None,
    *,
    gripper: Gripper | str | None = None,
    most: int = 5,
    seen_only: bool = False,
    experiences: ExperienceStore | None = None,
    weights: DgcmNet | Path | None = None,
    part: str | None = None,
    seed: int = 0,
) -> list[Grasp]: ...
def draw_grasps(
    rgb: ArrayLike,
    grasps: Sequence[Grasp],
    camera: Camera,
    *,
    gripper: Gripper | str | None = None,
    depth: ArrayLike | None = None,
) -> Bytes: ...

class DgcmNet:
    @classmethod
    def load(cls, path: Path) -> DgcmNet: ...
    @property
    def card(self) -> dict[str, Any]: ...
    @property
    def fingerprint(self) -> str: ...
    def feature(self, depth: ArrayLike, camera: Camera, mask: ArrayLike, *, seed: int = 0) -> Float32: ...

class Experience:
    @property
    def id(self) -> int: ...
    @property
    def time(self) -> int: ...
    @property
    def object(self) -> str: ...
    @property
    def part(self) -> str | None: ...
    @property
    def gripper(self) -> str: ...
    @property
    def provenance(self) -> str: ...
    @property
    def network(self) -> str: ...
    @property
    def opening(self) -> float: ...
    @property
    def width(self) -> float: ...
    @property
    def camera_from_gripper(self) -> Float: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def table(self) -> tuple[float, float, float, float] | None: ...
    @property
    def mask(self) -> Bool: ...
    @property
    def region(self) -> Bool: ...
    @property
    def points(self) -> Float32: ...
    @property
    def normals(self) -> Float32: ...
    @property
    def coordinates(self) -> Float32: ...
    @property
    def feature(self) -> Float32: ...
    def picture(self) -> Bytes: ...

class ExperienceStore:
    def __new__(cls, path: Path, weights: DgcmNet | Path | None = None, *, create: bool = True) -> ExperienceStore: ...
    @property
    def path(self) -> PurePath: ...
    def __len__(self) -> int: ...
    def add(
        self,
        depth: ArrayLike,
        camera: Camera,
        mask: ArrayLike,
        grasp: Grasp | ArrayLike,
        *,
        object: str,
        part: str | None = None,
        gripper: Gripper | str | None = None,
        opening: float | None = None,
        width: float | None = None,
        provenance: str = "added by hand",
        weights: DgcmNet | Path | None = None,
        seed: int = 0,
    ) -> tuple[int, bool]: ...
    # Stands before `list`, because that method hides the built-in type in the rest of the class.
    def nearest(
        self,
        feature: ArrayLike,
        count: int = 10,
        *,
        part: str | None = None,
        without_object: str | None = None,
        weights: DgcmNet | Path | None = None,
    ) -> Dicts: ...
    def list(self) -> Dicts: ...
    def get(self, id: int) -> Experience | None: ...
    def forget(self, id: int) -> bool: ...
    def merge(self, other: Path) -> int: ...
    def refresh(self, out: Path, weights: DgcmNet | Path) -> int: ...
    def export(self, folder: Path) -> tuple[int, Texts]: ...

class Templates:
    @staticmethod
    def from_mesh(mesh: Mesh, *, coverage: Literal["above", "around"] = "above") -> Templates: ...
    @staticmethod
    def from_depth(views: Sequence[View], *, check_masks: bool = True) -> Templates: ...
    @staticmethod
    def load(path: Path) -> Templates: ...
    def save(self, path: Path) -> None: ...
    @property
    def diameter(self) -> float: ...
    @property
    def size(self) -> float: ...
    @property
    def source(self) -> Literal["mesh", "posed depth", "depth"]: ...
    @property
    def view_from_object(self) -> Float: ...
    @property
    def patches(self) -> Float32: ...
    def __len__(self) -> int: ...

class Mttm:
    def __new__(
        cls,
        templates: Templates | Mesh,
        mesh: Mesh | PpfModel | None = None,
        *,
        matcher: Literal["points", "network", "both"] = "both",
        weights: Path | None = None,
        cache: Path | None = None,
    ) -> Mttm: ...
    @property
    def templates(self) -> Templates: ...
    @property
    def has_mesh(self) -> bool: ...
    @property
    def matcher(self) -> Literal["points", "network", "both"]: ...
    @property
    def cache_note(self) -> str | None: ...

class MttmEstimate:
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def confidence(self) -> float: ...
    @property
    def template(self) -> int: ...
    @property
    def mask(self) -> Bool: ...
    @property
    def verification(self) -> dict[str, float]: ...

def estimate_mttm(
    scene: PpfScene | ArrayLike,
    model: Mttm | Templates | Mesh,
    camera: Camera | None = None,
    mask: ArrayLike | None = None,
    *,
    instances: int = 1,
    min_score: float = 0.45,
    seed: int = 0,
) -> list[MttmEstimate]: ...

class Photograph:
    def __new__(
        cls,
        rgb: ArrayLike,
        camera: Camera,
        camera_from_object: ArrayLike,
        mask: ArrayLike | None = None,
        *,
        name: str = "unnamed",
    ) -> Photograph: ...
    @property
    def name(self) -> str: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def rgb(self) -> Bytes: ...
    @property
    def mask(self) -> Bool | None: ...
    def with_pose(self, camera_from_object: ArrayLike) -> Photograph: ...

class RefinedPoses:
    @property
    def camera_from_object(self) -> Float: ...
    @property
    def moved(self) -> Float: ...
    @property
    def rotated(self) -> Float: ...
    @property
    def differences(self) -> Float: ...
    @property
    def dropped(self) -> list[str | None]: ...
    @property
    def still(self) -> bool: ...
    @property
    def places(self) -> int: ...
    @property
    def disagreement(self) -> float | None: ...
    @property
    def photographs(self) -> list[Photograph]: ...
    def __len__(self) -> int: ...

def refine_poses(
    mesh: Mesh | Sequence[Mesh],
    photographs: Sequence[Photograph],
    *,
    objects: ArrayLike | None = None,
    images: ArrayLike | None = None,
    scene: Literal["judge", "still", "moving"] = "judge",
    rough: tuple[float, float] = (0.006, 0.03),
    shared: int = 0,
    progress: Callable[[float], object] | None = None,
    seed: int = 0,
) -> RefinedPoses: ...

class SynthesizedView:
    @property
    def rgb(self) -> Bytes: ...
    @property
    def mask(self) -> Bool: ...
    @property
    def unseen(self) -> Bool: ...
    @property
    def unseen_fraction(self) -> float: ...
    @property
    def sources(self) -> list[int]: ...

def synthesize(
    mesh: Mesh,
    photographs: Sequence[Photograph],
    poses: ArrayLike,
    camera: Camera,
    *,
    weighting: Literal["network", "average", "best"] = "network",
    weights: Path | None = None,
    per_view: int = 6,
    leave_out: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> list[SynthesizedView]: ...

class Solid:
    def __new__(cls, mesh: Mesh, *, convex: bool = False) -> Solid: ...
    @property
    def part_count(self) -> int: ...
    def rest(self, start: ArrayLike | None = None) -> Float | None: ...

class GraspTrial:
    @property
    def world_from_object(self) -> Float: ...
    @property
    def outcome(self) -> Literal["held", "blocked", "missed", "lost_in_lift", "lost_in_shake"]: ...
    @property
    def held(self) -> bool: ...
    @property
    def gap(self) -> float: ...
    @property
    def raised(self) -> float: ...
    @property
    def slip(self) -> float: ...
    @property
    def turn(self) -> float: ...
    @property
    def pushed(self) -> float: ...
    @property
    def time(self) -> float: ...
    def __bool__(self) -> bool: ...

def synthetic_mesh(
    kind: Literal["can", "mug", "cup", "bottle", "bowl", "box", "clamp", "drill", "toy"] = "toy", *, seed: int = 0
) -> Mesh: ...
def drop_objects(
    solids: Sequence[Solid],
    *,
    radius: float = 0.18,
    reach: float = 0.31,
    upright: float = 0.5,
    stacked: float = 0.4,
    seed: int = 0,
) -> list[Float | None]: ...
def gripper_pose(tip: ArrayLike, approach: ArrayLike | None = None, closing: ArrayLike | None = None) -> Float: ...
def try_grasp(
    object: Solid | Mesh,
    world_from_gripper: ArrayLike,
    *,
    world_from_object: ArrayLike | None = None,
    gripper: Gripper | str | None = None,
    opening: float | None = None,
    friction: float | None = None,
    force: float | None = None,
    mass: float = 0.2,
    table_friction: float = 0.5,
    lift: float = 0.1,
) -> GraspTrial: ...
def train_pix2pose(
    material: Path | bop.Dataset | Mapping[int, Mesh],
    out: Path,
    *,
    ids: ArrayLike | None = None,
    frames: Sequence[tuple[int, int]] | None = None,
    split: str | None = None,
    renders_only: bool = False,
    network: Literal["compact", "paper", "resnet50"] = "compact",
    steps: int | None = None,
    per_object: int | None = None,
    learning_rate: float | None = None,
    adversarial: bool | None = None,
    frozen_stages: int = 2,
    render_fraction: float = 0.5,
    near_photographs: float = 0.5,
    rotation: float | None = None,
    size: int = 128,
    init: Path | None = None,
    encoder: Path | None = None,
    backgrounds: Path | None = None,
    mesh_colors: bool = True,
    convex_hull: bool = False,
    transformer_loss: bool = True,
    view_limits: bool = False,
    preset: Literal["published", "bop", "linemod", "lmo", "tless"] | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_detector(
    material: Path | bop.Dataset | Mapping[int, Mesh],
    out: Path,
    *,
    ids: ArrayLike | None = None,
    frames: Sequence[tuple[int, int]] | None = None,
    split: str | None = None,
    renders_only: bool = False,
    network: Literal["compact", "retinanet", "faster-rcnn", "mask-rcnn", "retinanet-anchors"] = "compact",
    backbone: Literal["lite0", "resnet50"] | None = None,
    steps: int = 8000,
    batch: int = 4,
    learning_rate: float = 0.002,
    encoder_rate: float = 0.3,
    frozen_stages: int = 2,
    size: int = 320,
    photograph_fraction: float = 0.45,
    render_fraction: float = 0.4,
    rotation: float | None = None,
    longest_side: int = 640,
    threshold: float = 0.4,
    init: Path | None = None,
    encoder: Path | None = None,
    backgrounds: Path | None = None,
    mesh_colors: bool = True,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_dgcm(
    out: Path,
    *,
    network: Literal["compact", "paper"] = "compact",
    steps: int | None = None,
    pairs: int | None = None,
    learning_rate: float | None = None,
    lambda_: float | None = None,
    views: int = 6000,
    encoder: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_mttm(
    out: Path,
    *,
    network: Literal["compact", "paper"] = "compact",
    steps: int | None = None,
    anchors: int | None = None,
    learning_rate: float | None = None,
    objects: int = 300,
    scenes: int = 500,
    encoder: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_nol(
    out: Path,
    *,
    network: Literal["compact", "paper"] = "compact",
    steps: int | None = None,
    learning_rate: float | None = None,
    backgrounds: Path | None = None,
    lstm: bool = True,
    decoder: bool = True,
    encoder: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_views(
    out: Path,
    *,
    steps: int = 12000,
    learning_rate: float = 0.001,
    batch: int = 8,
    backgrounds: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_refiner(
    out: Path,
    *,
    steps: int = 12000,
    learning_rate: float = 0.001,
    batch: int = 4,
    backgrounds: Path | None = None,
    init: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
def train_proposals(
    out: Path,
    *,
    steps: int = 8000,
    learning_rate: float = 0.002,
    batch: int = 4,
    objects: int = 400,
    size: int = 320,
    backgrounds: Path | None = None,
    progress: Progress | None = None,
    seed: int = 0,
) -> dict[str, Any]: ...
