"""Calls of the steps: typed arguments and results.

The arguments of a call are the arguments of its step: `**locals()` passes all of them on by name.
"""

from flows.engine.requests import Conversion, Part
from flows.engine.running import run_step
from steps.contract import ArtifactRef, StepResult
from steps.profiles import ScoreAssetSettings


class Picture(StepResult):
    """Picture that a text-to-image model generated."""

    @property
    def picture(self) -> ArtifactRef:
        """PNG."""
        return self.outputs["picture"]


class Subject(StepResult):
    """Cut-out of the subject, and its footage where the source is a video."""

    @property
    def footage(self) -> ArtifactRef | None:
        """Frames of the video, cut out."""
        return self.outputs.get("footage")


class Asset(Subject):
    """Model of the user's own, placed; with its render as the subject where there is no picture."""


class KnownViews(StepResult):
    """Pictures of other sides, with their cameras."""


class DrivingVideo(StepResult):
    """Driving video; with contact sheet, ranking and videos if it was selected among candidates."""

    @property
    def frames(self) -> ArtifactRef:
        """Frames with alpha, and their rate."""
        return self.outputs["driving_video"]


class Gaussians(StepResult):
    """Static 3D Gaussians."""


class Motion(StepResult):
    """Deformation over time; with the Gaussians if they were fine-tuned or strays were dropped."""


class Plan(StepResult):
    """Mesh mode for the motion, and the density threshold of the surface."""

    @property
    def plan(self) -> ArtifactRef:
        """JSON of `steps.artifacts.mesh_plan`."""
        return self.outputs["plan"]


class Mesh(StepResult):
    """Either one tracked mesh or a mesh per frame; or the plan of the latter, where the former loses the video."""


class Package(StepResult):
    """Packaged 4D asset."""

    @property
    def package(self) -> ArtifactRef:
        """Zip of all files."""
        return self.outputs["package"]


class Verdict(StepResult):
    """Verdict of the quality gates."""


class Scores(StepResult):
    """Metrics of an asset against the ground truth."""


def draw_picture(text: ArtifactRef, conversion: Conversion) -> Picture:
    """Generate a picture from a prompt."""
    return run_step("draw_picture", Picture, **locals())


def prepare_subject(
    source: ArtifactRef,
    conversion: Conversion,
    mask: ArtifactRef | None = None,
    depth: ArtifactRef | None = None,
    layers: ArtifactRef | None = None,
) -> Subject:
    """Read a picture or video, cut the subject out, by the user's mask if there is one, and center it."""
    return run_step("prepare_subject", Subject, **locals())


def prepare_views(
    views: ArtifactRef,
    source: ArtifactRef,
    subject: Subject,
    conversion: Conversion,
    mask: ArtifactRef | None = None,
) -> KnownViews:
    """Cut out pictures of other sides, bring them to the scale of the input and compare them with it."""
    return run_step("prepare_views", KnownViews, **locals())


def generate_views(subject: Subject, conversion: Conversion) -> KnownViews:
    """Generate views of other sides with an image-editing model and weight them by their agreement."""
    return run_step("generate_views", KnownViews, **locals())


def prepare_asset(model: ArtifactRef, conversion: Conversion, subject: Subject | None = None) -> Asset:
    """Read a model of the user's own and find its azimuth, scale and position in the first frame."""
    return run_step("prepare_asset", Asset, **locals())


def animate_asset(asset: Asset, driving_video: DrivingVideo, conversion: Conversion) -> Motion:
    """Fit the motion of a model to the driving video, as rigid as its surface allows."""
    return run_step("animate_asset", Motion, **locals())


def drive_video(subject: Subject, conversion: Conversion) -> DrivingVideo:
    """Take the footage of the subject, or generate a video of it in motion."""
    return run_step("drive_video", DrivingVideo, **locals())


def fit_gaussians(
    subject: Subject, conversion: Conversion, bank: ArtifactRef | None = None, known_views: KnownViews | None = None
) -> Gaussians:
    """Fit static 3D Gaussians to the picture (DreamGaussianHD)."""
    return run_step("fit_gaussians", Gaussians, **locals())


def fit_motion(
    subject: Subject,
    gaussians: Gaussians,
    driving_video: DrivingVideo,
    conversion: Conversion,
    bank: ArtifactRef | None = None,
    known_views: KnownViews | None = None,
) -> Motion:
    """Fit a HexPlane deformation to the driving video (paper, "Gaussian Deformation for Dynamic Generation")."""
    return run_step("fit_motion", Motion, **locals())


def plan_mesh(
    gaussians: Gaussians | Asset,
    motion: Motion,
    conversion: Conversion,
    driving_video: DrivingVideo | None = None,
    subject: Subject | None = None,
) -> Plan:
    """Decide whether one mesh can follow the motion or every frame needs its own.

    With the subject, the shape of one mesh is predicted by the shape network.
    """
    return run_step("plan_mesh", Plan, **locals())


def extract_mesh(
    gaussians: Gaussians | Asset,
    motion: Motion,
    plan: Plan | Mesh,
    conversion: Conversion,
    driving_video: DrivingVideo | None = None,
    part: Part | None = None,
    subject: Subject | None = None,
) -> Mesh:
    """Extract one mesh that follows the motion, or a mesh per frame of a part of the frames.

    Textures take their colors from the driving video, if it is given, where it shows the surface. With the subject, the
    shape of one mesh is predicted by the shape network. A tracked mesh that loses the video may be given up for the
    plan of a mesh per frame.
    """
    return run_step("extract_mesh", Mesh, **locals())


def join_meshes(parts: list[Mesh], conversion: Conversion) -> Mesh:
    """Join the meshes of all parts."""
    return run_step("join_meshes", Mesh, **locals())


def refine_texture(subject: Subject, mesh: Mesh, driving_video: DrivingVideo, conversion: Conversion) -> Mesh:
    """Refine the textures with a video-to-video diffusion model, conditioned on the subject."""
    return run_step("refine_texture", Mesh, **locals())


def pack_asset(
    subject: Subject,
    driving_video: DrivingVideo,
    gaussians: Gaussians | Asset,
    motion: Motion,
    mesh: Mesh,
    notes: tuple[str, ...],
    conversion: Conversion,
) -> Package:
    """Write every delivery format into one package."""
    return run_step("pack_asset", Package, **locals())


def check_asset(package: Package, driving_video: DrivingVideo, subject: Subject, conversion: Conversion) -> Verdict:
    """Compare the package with the driving video and check the quality gates."""
    return run_step("check_asset", Verdict, **locals())


def score_asset(
    truth: ArtifactRef, settings: ScoreAssetSettings, conversion: Conversion, package: ArtifactRef | None = None
) -> Scores:
    """Score an asset, or the naive baselines, against the ground truth."""
    return run_step("score_asset", Scores, **locals())
