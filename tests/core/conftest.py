"""A body small enough to write, break and skin many times."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import ShapedBody, load_body
from trilane.body.joints import JOINT_PARENTS
from trilane.hw_profiles.fit import ProfileFit, fit_profile

VERTICES, FACES, CORNERS = 90, 120, 130


@pytest.fixture(scope="session")
def fitted(shared_data: Path) -> ProfileFit:
    """The fit of the committed profile of the Snapdragon 888, which takes seconds."""
    pytest.importorskip("scipy")
    return fit_profile("snapdragon-888-facts", shared_data / "snapdragon888_measured.csv")


@pytest.fixture(scope="session")
def body() -> ShapedBody:
    """The default body in its mean shape."""
    return load_body(bundle_folder("default") / "body.npz").shape()


@pytest.fixture
def body_arrays() -> dict[str, NDArray[Any]]:
    """The arrays of a body file: 90 vertices around 55 joints, up to 6 weights each, pose blend shapes not zero."""
    random = np.random.default_rng(11)
    vertices = random.normal(0, 0.3, (VERTICES, 3))
    weights = np.zeros((VERTICES, 55))
    for row in weights:
        row[random.choice(55, random.integers(1, 7), replace=False)] = 1.0
    weights *= random.uniform(0.1, 1.0, weights.shape)
    weights /= weights.sum(axis=1, keepdims=True)
    regressor = random.uniform(0, 1, (55, VERTICES)) ** 8
    floats = {
        "v_template": vertices,
        "shapedirs": random.normal(0, 0.01, (VERTICES, 3, 20)),
        "posedirs": random.normal(0, 0.002, (VERTICES, 3, 486)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights,
        "vt": random.uniform(0, 1, (CORNERS, 2)),
        "hands_componentsl": np.eye(45),
        "hands_componentsr": np.eye(45),
        "hands_meanl": random.normal(0, 0.2, 45),
        "hands_meanr": random.normal(0, 0.2, 45),
    }
    integers = {
        "f": random.integers(0, VERTICES, (FACES, 3)),
        "ft": random.integers(0, CORNERS, (FACES, 3)),
        "kintree_table": np.array([np.array(JOINT_PARENTS) % 2**32, range(55)]),
    }
    arrays: dict[str, NDArray[Any]] = {key: value.astype(np.float32) for key, value in floats.items()}
    return arrays | {key: value.astype(np.uint32) for key, value in integers.items()}


@pytest.fixture
def shaped(tmp_path: Path, body_arrays: dict[str, NDArray[Any]]) -> ShapedBody:
    """The body of `body_arrays` in its mean shape."""
    np.savez(tmp_path / "body.npz", allow_pickle=False, **body_arrays)
    return load_body(tmp_path / "body.npz").shape()


HELD = Path(__file__).with_name("held.json")
#: Relative to the sum of the magnitudes: the same sums in another order, or by another library, differ by less.
CLOSE = 1e-6


@pytest.fixture
def held(request: pytest.FixtureRequest) -> Callable[[str, Any], None]:
    """Compare numbers with those that held.json has for this test: none changes unless somebody means it.

    Of an array its size and three sums are kept: of the values, of their magnitudes, and weighted by place, so that an
    exchange is seen. TRILANE_WRITE_HELD=1 writes the file again; read the difference before committing it.
    """
    writes = "TRILANE_WRITE_HELD" in os.environ
    test = request.node.name

    def check(what: str, values: Any) -> None:
        array = np.asarray(values, np.float64).ravel()
        place = np.cos(0.7 * np.arange(len(array)) + 0.3)
        found = [float(len(array)), float(array.sum()), float(np.abs(array).sum()), float(array @ place)]
        everything = json.loads(HELD.read_text(encoding="utf-8")) if HELD.is_file() else {}
        if writes:
            everything.setdefault(test, {})[what] = [float(f"{value:.10g}") for value in found]
            HELD.write_text(json.dumps(everything, indent=0, sort_keys=True) + "\n", encoding="utf-8")
        assert found == pytest.approx(everything[test][what], abs=CLOSE * max(found[2], 1e-9), rel=0), what

    return check


PRINTED = Path(__file__).with_name("printed")
#: `trilane ARGUMENTS` in this process: what it prints on stdout and on stderr; it must end with the exit code `code`.
Command = Callable[..., tuple[str, str]]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments: object, code: int = 0) -> tuple[str, str]:
        from trilane.apps.cli.main import main

        monkeypatch.setattr("sys.argv", ["trilane", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        out, err = capsys.readouterr()
        assert int(left.value.code or 0) == code, err
        return out, err

    return run


@pytest.fixture
def check_printed() -> Callable[[str, str], None]:
    """Compare with printed/NAME.txt, line by line and word by word: how a table is framed is its library's matter.

    TRILANE_WRITE_PRINTED=1 writes the file again; read the difference before committing it.
    """

    def check(name: str, text: str) -> None:
        lines = [" ".join(re.sub(r"[─-╿|]", " ", line).split()) for line in text.splitlines()]
        file, text = PRINTED / f"{name}.txt", "".join(f"{line}\n" for line in lines if line)
        if "TRILANE_WRITE_PRINTED" in os.environ:
            file.write_text(text, encoding="utf-8")
        assert text.splitlines() == file.read_text(encoding="utf-8").splitlines()

    return check
