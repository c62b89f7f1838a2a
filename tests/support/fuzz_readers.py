"""Every reader of people's files, fed with changed files: `support.fuzz_readers --seconds 600`.

Rule: a reader gives something sound, or refuses with one sentence that names the file. Any other exception, a warning,
a file or thread that is left open, a file that is left behind, or more than MOST_S is a finding; its seed and number
make it again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import shutil
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

import numpy as np

from support.mutations import mutated
from support.small_inputs import write_small_inputs
from trilane.apps.cli.console import without_controls
from trilane.apps.cli.inspect import lines
from trilane.apps.inspect.inspect_file import inspect_file
from trilane.apps.inspect.inspection import Inspection
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import read_network
from trilane.body.body import load_body
from trilane.errors import BadInputError
from trilane.hw_profiles.graph_file import read_graph
from trilane.scene.camera.files import load_camera
from trilane.scene.motion.files import load_motion
from trilane.scene.schema import AvatarSpec, CameraSpec, load_scene, scene_from
from trilane.stages.gpu.background import open_background

MOST_S = 20.0
DRAWN = 0.1  # of the cases
#: What Python says of its own objects: in a sentence for people it is a defect that was taken for bad input.
INTERNAL = re.compile(
    r"object has no attribute|object is not|index out of range|unsupported operand|NoneType|not subscriptable|"
    r"positional argument|could not broadcast|Traceback|operands could not|must be real number|KeyError"
)


def _motion(path: Path) -> None:
    motion = load_motion(AvatarSpec(motion=str(path)), Path())
    poses, places = motion.sample_all(np.linspace(0, 2 * motion.duration_s, 3))
    assert np.isfinite(poses).all() and np.isfinite(places).all(), "a motion that is not finite"
    assert (np.diff(motion.times_s) > 0).all() and motion.times_s[0] == 0, "times of a motion that do not increase"


def _camera(path: Path) -> None:
    camera = load_camera(CameraSpec(source=str(path)), Path())
    assert np.isfinite(camera.places).all() and np.isfinite(camera.quats).all(), "a camera that is not finite"
    assert np.allclose(np.linalg.norm(camera.quats, axis=-1), 1, atol=1e-6), "quaternions that are no turns"
    assert (np.diff(camera.times_s) > 0).all() and camera.times_s[0] == 0, "times of a camera that do not increase"
    for t_s in (0.0, camera.duration_s / 3):
        assert np.isfinite(camera.projection(t_s, (48, 64))).all(), "a projection that is not finite"


def _background(path: Path) -> None:
    background = open_background(path, (36, 48), 30.0)
    try:
        for t_s in (0.0, 0.1, 0.5):
            background.at(t_s)
    finally:
        background.close()


def _avatar(path: Path) -> None:
    bundle = load_bundle(path)
    assert np.isfinite(bundle.read_texture()).all()
    bundle.read_network()
    load_body(bundle.body_path).shape(bundle.manifest.betas, bundle.manifest.expression)


def _body(path: Path) -> None:
    shaped = load_body(path).shape()
    bare = shaped.bare()
    assert np.isfinite(shaped.vertices).all() and np.isfinite(bare.vertices).all()
    assert bare.body.faces.max() < len(bare.vertices), "a triangle of the skin that has a vertex of a garment"


def _scene(path: Path) -> None:
    scene_from(path, load_scene(path))


def _network(path: Path) -> None:
    try:
        read_network(path)
    except BadInputError:
        read_graph(path)


def _inspect(path: Path) -> Inspection:
    found = inspect_file(path)
    json.dumps(found.document(path, None), allow_nan=False)
    for line in lines(found, path, None):
        without_controls(line).encode("utf-8", errors="surrogateescape")
    return found


def _draw(path: Path) -> None:
    """Of few cases: a sheet takes ten times as long as reading."""
    found = _inspect(path)
    if found.draw is not None:
        found.draw()


#: Input of `small_inputs` -> its reader. Of a folder one file is changed.
READERS: dict[str, Callable[[Path], None]] = {
    "walk.bvh": _motion,
    "poses.npy": _motion,
    "amass.npz": _motion,
    "parts.npz": _motion,
    "aist.pkl": _motion,
    "romp.npz": _motion,
    "places.npy": _motion,
    "arkit.txt": _camera,
    "tum.txt": _camera,
    "transforms.json": _camera,
    "euroc.csv": _camera,
    "kitti.txt": _camera,
    "metadata.json": _camera,
    "odometry.csv": _camera,
    "colmap": _camera,
    "colmap-binary": _camera,
    "photo.png": _background,
    "photo.jpg": _background,
    "film.mkv": _background,
    "pictures": _background,
    "body.npz": _body,
    "network.onnx": _network,
    "scene.toml": _scene,
    "avatar": _avatar,
}


@dataclass(frozen=True)
class Finding:
    """What case `number` of `seed` did with the changed `name`."""

    seed: int
    number: int
    name: str
    what: str

    def __str__(self) -> str:
        return f"--seed {self.seed} --first {self.number} ({self.name}): {self.what}"


class Fuzzer:
    """Cases by seed and number, tried in a folder of their own."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.seed, self.outcomes = seed, Counter[str]()
        self._sound, self._tried = folder / "sound", folder / "tried"
        self._sound.mkdir()
        self._inputs = write_small_inputs(self._sound)
        self._contents = tuple(path.read_bytes() for path in self._inputs.values() if path.is_file())

    def sound(self) -> list[Finding]:
        """Findings of what nobody changed: it must be read."""
        return [
            Finding(self.seed, -1, name, what)
            for name, path in self._inputs.items()
            for what in (_outcome(READERS[name], path), _outcome(_draw, path))
            if what != "read"
        ]

    def case(self, number: int) -> list[Finding]:
        """What is wrong with how case `number` is read; empty when nothing is."""
        random = Random(f"{self.seed} {number}")
        name = random.choice(sorted(READERS))
        path = self._changed(name, random)
        before = open_files(self._tried), threading.active_count(), _listing(self._tried)
        said = []
        for read in (READERS[name], _draw if random.random() < DRAWN else _inspect):
            begun = time.monotonic()
            said.append(_outcome(read, path))
            if (took := time.monotonic() - begun) > MOST_S:
                said.append(f"took {took:.0f} s")
        for then, now, what in zip(before, self._after(before[1]), ("files", "threads", "names"), strict=True):
            if then != now:
                said.append(f"open or left {what}: {then} before, {now} after")
        self.outcomes.update(f"{name}: {what}" for what in said[:1] if what in ("read", "refused"))
        return [Finding(self.seed, number, name, what) for what in said if what not in ("read", "refused")]

    def _after(self, threads: int) -> tuple[list[str], int, list[str]]:
        deadline = time.monotonic() + 2
        while threading.active_count() > threads and time.monotonic() < deadline:
            time.sleep(0.01)
        return open_files(self._tried), threading.active_count(), _listing(self._tried)

    def _changed(self, name: str, random: Random) -> Path:
        shutil.rmtree(self._tried, ignore_errors=True)
        self._tried.mkdir()
        source = self._inputs[name]
        if source.is_dir():
            path = self._tried / name
            shutil.copytree(source, path)
            file = random.choice(sorted(each for each in path.rglob("*") if each.is_file()))
        else:
            file = path = self._tried / name
            file.write_bytes(source.read_bytes())
            if random.random() < 0.03:  # under the name of another kind
                other = random.choice([each for each in sorted(READERS) if each.endswith(source.suffix)])
                file = path = file.rename(self._tried / other)
        file.write_bytes(mutated(file.read_bytes(), file.suffix, random, self._contents))
        return path


def open_files(below: Path) -> list[str]:
    """Files below a folder that this process holds open; libraries may open their own at any time."""
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # of the listing itself, which is over
            found.append(str(link.readlink()))
    return sorted(name for name in found if name.startswith(f"{below}/"))


def _listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def _outcome(read: Callable[[Path], object], path: Path) -> str:
    """`read`, `refused`, or what is wrong."""
    with warnings.catch_warnings(action="error"):
        try:
            read(path)
        except BadInputError as error:
            return _wrong_sentence(error, path) or "refused"
        except Exception:
            return traceback.format_exc(limit=-4)
    return "read"


def _wrong_sentence(error: BadInputError, path: Path) -> str:
    sentence = str(error)
    if path.name not in error.where:
        return f"a sentence that does not name the file: {sentence}"
    if not error.found.strip() or not error.expected.strip():
        return f"a sentence with a hole: {sentence}"
    if INTERNAL.search(sentence):
        return f"a sentence about Python: {sentence}"
    return f"a sentence of {len(sentence)} letters: {sentence[:200]}" if len(sentence) > 1500 else ""


def findings(fuzzer: Fuzzer, seconds: float, first: int = 0, count: int | None = None) -> Iterator[Finding]:
    """Those of the sound files and of the cases from `first` on, for `seconds`, at most `count` cases."""
    yield from fuzzer.sound()
    begun, number = time.monotonic(), first
    while time.monotonic() - begun < seconds and (count is None or number < first + count):
        yield from fuzzer.case(number)
        number += 1


def main() -> int:
    """Print the findings and how often each reader read or refused. Exit code 1 with findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int)
    asked = parser.parse_args()
    found = 0
    with tempfile.TemporaryDirectory(prefix="trilane-fuzz-") as folder, contextlib.suppress(KeyboardInterrupt):
        fuzzer = Fuzzer(Path(folder), asked.seed)
        for finding in findings(fuzzer, asked.seconds, asked.first, asked.count):
            found += 1
            print(finding, flush=True)
        for what, times in sorted(fuzzer.outcomes.items()):
            print(f"{times:7} {what}")
        print(f"{fuzzer.outcomes.total()} cases, {found} findings, seed {asked.seed}")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
