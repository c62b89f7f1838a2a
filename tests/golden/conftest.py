"""An OpenGL context, the default body and cameras for the tests that draw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from trilane.arrays import F32, F64
from trilane.avatars.bundle import bundle_folder
from trilane.body.body import Body, load_body
from trilane.body.joints import Skeleton
from trilane.body.skinning import largest_weights
from trilane.errors import MissingPartError
from trilane.stages.configure import Checked, configure
from trilane.stages.gpu.opengl import open_context
from trilane.stages.gpu.skinned_mesh import MeshArrays, SkinnedMesh, mesh_arrays
from trilane.stages.run_options import RunOptions

HERE = Path(__file__).parent
FAILED = HERE / "failed"


@pytest.fixture(scope="session")
def gl() -> Any:
    """A context; the test is skipped where no driver is."""
    try:
        return open_context(2)
    except MissingPartError as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def current(gl: Any) -> None:
    """Make the shared context the current one: some tests open their own."""
    gl.__enter__()


@dataclass(frozen=True)
class Person:
    """The default body on the GPU. `pose` gives skinning matrices (55,3,4) for axis-angle numbers (165,)."""

    body: Body
    arrays: MeshArrays
    mesh: SkinnedMesh
    skeleton: Skeleton
    rest: F64

    def pose(self, numbers: NDArray[np.floating[Any]]) -> F32:
        return self.skeleton.pose(numbers, translation=(0.0, 0.94, 0.0)).matrices.copy()


@pytest.fixture(scope="session")
def person(gl: Any) -> Person:
    """The default body with eight weights a vertex, standing on the floor."""
    gl.__enter__()
    body = load_body(bundle_folder("default") / "body.npz")
    shaped = body.shape()
    top = largest_weights(body.weights, 8)
    arrays = mesh_arrays(shaped.vertices, body.faces, body.uv, body.uv_faces, top.joints, top.weights)
    return Person(body, arrays, SkinnedMesh(gl, arrays), Skeleton(shaped.joints, body.parents), shaped.joints)


@pytest.fixture(scope="session")
def opened_renderer(gl: Any) -> Any:  # noqa: ARG001 - where no context can be made, `gl` skips the test
    """The renderer of training's samples, with a context of its own."""
    from trilane.training.sample_renderer import SampleRenderer

    return SampleRenderer(load_body(bundle_folder("default") / "body.npz").shape(), threads=2)


@pytest.fixture
def renderer(opened_renderer: Any) -> Any:
    """The renderer, its context the current one."""
    opened_renderer.ctx.__enter__()
    return opened_renderer


def perspective(fov_y_deg: float, aspect: float, near: float = 0.05, far: float = 100.0) -> F64:
    """An OpenGL projection."""
    q = 1 / np.tan(np.radians(fov_y_deg) / 2)
    depth = near - far
    rows = [[q / aspect, 0, 0, 0], [0, q, 0, 0], [0, 0, (far + near) / depth, 2 * far * near / depth], [0, 0, -1, 0]]
    return np.array(rows)


def look_at(eye: Any, target: Any) -> F64:
    """World to camera, y up."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    view = np.eye(4)
    view[:3, :3] = [right, np.cross(right, forward), -forward]
    view[:3, 3] = -view[:3, :3] @ np.asarray(eye, float)
    return view


@pytest.fixture(scope="session")
def camera() -> Callable[..., tuple[F64, F64]]:
    """(view, projection) of a camera at `eye` that looks at `target`."""

    def make(eye: Any, target: Any, fov_y_deg: float = 40.0, aspect: float = 1.0, **planes: float) -> tuple[F64, F64]:
        return look_at(eye, target), perspective(fov_y_deg, aspect, **planes)

    return make


@pytest.fixture(scope="session")
def neural_texture() -> NDArray[np.float64]:
    """(128,128,16): smooth noise of deviation 1, as FP16 holds it, from a fixed seed."""
    rng = np.random.default_rng(5)
    coarse = rng.normal(size=(17, 17, 16))
    rows, columns = np.indices((128, 128)) / 8.0
    top, left = rows.astype(int), columns.astype(int)
    dy, dx = (rows - top)[..., None], (columns - left)[..., None]
    upper = coarse[top, left] * (1 - dx) + coarse[top, left + 1] * dx
    lower = coarse[top + 1, left] * (1 - dx) + coarse[top + 1, left + 1] * dx
    smooth = upper * (1 - dy) + lower * dy
    return (smooth / smooth.std()).astype(np.float16).astype(np.float64)


@pytest.fixture(scope="session")
def golden() -> Callable[[str, NDArray[np.uint8], float, float], None]:
    """Compare a picture with tests/golden/NAME.png; on failure keep picture and difference in tests/golden/failed."""

    def check(name: str, picture: NDArray[np.uint8], mean: float, share_over_8: float) -> None:
        expected_path = HERE / f"{name}.png"
        if not expected_path.is_file():
            _keep(name, picture)
            pytest.fail(f"no {expected_path}; the picture is in {FAILED}")
        with Image.open(expected_path) as image:
            expected = np.asarray(image)
        assert expected.shape == picture.shape
        off = np.abs(picture.astype(int) - expected)
        if off.mean() > mean or (off > 8).mean() > share_over_8:
            _keep(name, picture)
            _keep(f"{name}-difference", np.clip(off * 4, 0, 255).astype(np.uint8))
            pytest.fail(f"{name}: mean {off.mean():.3f} (at most {mean}), over 8: {(off > 8).mean():.2%}; see {FAILED}")

    return check


def _keep(name: str, picture: NDArray[np.uint8]) -> None:
    FAILED.mkdir(exist_ok=True)
    Image.fromarray(picture).save(FAILED / f"{name}.png")


@pytest.fixture(scope="session")
def far_scene() -> Callable[[str | Path, Path], Checked]:
    """Makes in a folder a scene of 12 small frames, in which the camera is far from the avatar."""

    def made(bundle: str | Path, folder: Path) -> Checked:
        file = folder / "far.toml"
        size = 'size = "64x64"\noutput = {width = 160, height = 128}\ncamera = {source = "builtin:far"}'
        file.write_text(f'frames = 12\nfps = 6\n{size}\n[[avatars]]\nbundle = "{bundle}"\n', encoding="utf-8")
        return configure(RunOptions(scene=str(file), runtime="ort", skinning="cpu"), folder)

    return made


@pytest.fixture(scope="module")
def checked(drawable_bundle: Path, far_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Checked:
    """The far scene of the avatar with the tiny network."""
    return far_scene(drawable_bundle, tmp_path_factory.mktemp("scene"))
