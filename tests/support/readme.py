"""The marked blocks of README.md: `make readme` writes them, and a test holds them.

Rule: a block stands between `<!-- NAME: written by make readme -->` and `<!-- end of NAME -->`. What is computed, or
comes from a committed file, is made again and compared. What was measured is compared with `docs/results/readme.json`,
which has the command, the time, the machine and the output. Use: `python tests/support/readme.py [--measured]`; without
the option nothing is measured, and measured blocks stay what the record says.
"""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, Final

from trilane import machine

ROOT: Final = Path(__file__).resolve().parents[2]
README, RECORD = ROOT / "README.md", ROOT / "docs" / "results" / "readme.json"
PREDICT: Final = ("predict", "--profile", "snapdragon-888", "--encoder", "resnet18", "--size", "512")
PICTURE: Final = ROOT / "docs" / "images" / "dashboard.gif"
PICTURE_S, PICTURES_A_SECOND, PICTURE_SIZE = 6.0, 5, (960, 600)
RUN: Final = ("run", "--frames", "120", "--baseline", "30", "--check", "2")
PLACE: Final = "runs/first"
VERDICT_LINES: Final = 7
#: Speeds of the page, as its control has them.
RATES: Final = ("1", "0.5", "0.25", "0.1", "0.02")
COLOURS: Final = 128
SETTLES_MS: Final = 5000
BLOCK: Final = r"(<!-- {name}: written by make readme -->\n)(.*?)(<!-- end of {name} -->)"


def block(text: str, name: str) -> str:
    """The content of a block. Raises ValueError where README.md has none of that name, or several."""
    found = re.findall(BLOCK.format(name=re.escape(name)), text, re.DOTALL)
    if len(found) != 1:
        raise ValueError(f"README.md: block {name}: found {len(found)}, expected 1")
    return str(found[0][1])


def _marked(name: str, content: str) -> str:
    return f"<!-- {name}: written by make readme -->\n{content}<!-- end of {name} -->"


def filled(text: str, contents: dict[str, str]) -> str:
    """`text` with the content of each block."""
    for name, content in contents.items():
        text = text.replace(_marked(name, block(text, name)), _marked(name, content))
    return text


def claim() -> str:
    """How far predictions are off, from the table in docs/predict.md that `make results` computes."""
    page = (ROOT / "docs" / "predict.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `\w+` \| (\d+) \| (\d+) % \|", page, re.MULTILINE)
    errors, count = [int(error) for _, error in rows], sum(int(count) for count, _ in rows)
    networks = re.findall(r"latencies of (\d+) networks", page)[0]
    how = "[how, and where it is worse](docs/predict.md#how-far-off-it-is)"
    return (
        f"Latencies of networks on Snapdragon chips are predicted to within **{min(errors)} to {max(errors)} % in the "
        f"median**,\nagainst {count} published rows of {networks} networks. "
        f"Each row is predicted by a fit that has not seen its network\n({how}).\n"
    )


def shell(command: tuple[str, ...], output: str) -> str:
    """A block of code: a command, then what it prints."""
    lines = "\n".join(line.rstrip() for line in output.rstrip().splitlines())
    return f"```\n$ trilane {' '.join(command)}\n{lines}\n```\n"


def trilane(*arguments: str, codes: tuple[int, ...] = (0,)) -> str:
    """What a command prints on stdout. Raises RuntimeError for another exit code."""
    done = subprocess.run([sys.executable, "-m", "trilane", *arguments], capture_output=True, text=True, check=False)
    if done.returncode not in codes:
        raise RuntimeError(f"trilane {' '.join(arguments)}: exit code {done.returncode}: {done.stderr}")
    return done.stdout


def prediction(run: Callable[..., str] = trilane) -> str:
    """The verdict of a prediction."""
    return shell(PREDICT, "\n".join(run(*PREDICT).splitlines()[:VERDICT_LINES]))


def sizes() -> str:
    """Speed beside error by tensor size, of the project's own sweep on OpenVINO: medians over the runs of a size."""
    with (ROOT / "docs" / "results" / "report.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["runtime"] == "openvino" and not row["failure"]]
    by_size: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        by_size.setdefault(row["size"], []).append(row)
    (runs,), (frames,) = {len(each) for each in by_size.values()}, {_checked(row) for row in rows}
    lines = [f"| {size} | {_between(each)} | {_median(each, 'psnr_db'):.1f} |" for size, each in by_size.items()]
    how = (
        f"Runs of each size: {runs}. The time is their median, in brackets the outermost ends of their 95 % intervals. "
        f"Frames of each run that the PSNR covers: {frames}.\n"
    )
    return "\n".join(["| tensor size | ms a frame | PSNR, dB |", "|--:|--:|--:|", *lines, "", how])


def _median(runs: list[dict[str, str]], name: str) -> float:
    return median(float(run[name]) for run in runs)


def _between(runs: list[dict[str, str]]) -> str:
    """The median frame time, and the outermost ends of the runs' intervals."""
    low, high = min(float(run["low_ms"]) for run in runs), max(float(run["high_ms"]) for run in runs)
    return f"{_median(runs, 'frame_ms'):.1f} ({low:.1f} to {high:.1f})"


def _checked(run: dict[str, str]) -> int:
    """How many frames of a run were compared."""
    return int(re.findall(r"(\d+) frames", run["error_source"])[0])


def measured(record: dict[str, Any]) -> dict[str, str]:
    """The blocks of the recorded run."""
    machine = f"{record['machine']}, {record['at']}"
    return {
        "verdict": shell(tuple(record["run"]["command"]), record["run"]["output"]) + f"\nMeasured: {machine}.\n",
        "explain": shell(tuple(record["explain"]["command"]), record["explain"]["output"]),
    }


def film(folder: str) -> None:
    """Write the picture of the dashboard: six seconds of a finished run that plays from its begin."""
    from PIL import Image
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "trilane", "show", folder]
    shots: list[tuple[float, Image.Image]] = []
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as served, sync_playwright() as driver:
        try:
            assert served.stderr is not None
            url = next(line.split()[1] for line in served.stderr if line.startswith("dashboard: "))
            browser = driver.chromium.launch(executable_path=machine.here.program("chromium"), args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(url)
            page.wait_for_selector("#verdict div")
            page.wait_for_timeout(SETTLES_MS)
            page.locator("#seek").fill("0")
            page.locator("#seek-rate").select_option(_rate(float(page.locator("#seek").get_attribute("max") or 0)))
            page.locator("#seek-play").click()
            begin_s = time.monotonic()
            while time.monotonic() < begin_s + PICTURE_S:
                page.wait_for_timeout(1000 / PICTURES_A_SECOND)
                picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB").resize(PICTURE_SIZE)
                shots.append((time.monotonic(), picture.quantize(COLOURS)))
            browser.close()
        finally:
            served.terminate()
    times = [begin_s, *(at_s for at_s, _ in shots)]
    lasts_ms = [round(1000 * (after - before)) for before, after in pairwise(times)]
    first, *rest = (picture for _, picture in shots)
    first.save(PICTURE, save_all=True, append_images=rest, duration=lasts_ms, loop=0)


def _rate(run_ms: float) -> str:
    """The fastest speed of the page at which a run of `run_ms` moves for most of the picture's time."""
    return next((rate for rate in RATES if run_ms / float(rate) > 800 * PICTURE_S), RATES[-1])


def recorded() -> dict[str, Any]:
    """Run the scene, explain it and film its dashboard."""
    with tempfile.TemporaryDirectory(prefix="trilane-readme-") as place:
        folder = str(Path(place) / "run")
        run = trilane(*RUN, "--out", folder).replace(folder, PLACE)
        table = trilane("explain", folder).replace(folder, PLACE).splitlines()
        film(folder)
        report = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))
    first = next(number for number, line in enumerate(table) if line.startswith("What bounded the frame time"))
    last = next(number for number, line in enumerate(table) if line.startswith("└"))
    cpu, gl = report["machine"]["cpu"], report["machine"]["gl"]
    cores = f"{len(cpu['cores_allowed'])} cores of {cpu['model']}, {gl['renderer'] if gl else 'no OpenGL'}"
    return {
        "at": report["made"]["at"],
        "machine": cores,
        "run": {"command": [*RUN, "--out", PLACE], "output": run.rstrip()},
        "explain": {"command": ["explain", PLACE], "output": "\n".join(table[first : last + 1])},
    }


def contents(run: Callable[..., str] = trilane) -> dict[str, str]:
    """All blocks, as they have to be."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    return {"claim": claim(), "prediction": prediction(run), "sizes": sizes(), **measured(record)}


def main(arguments: list[str]) -> None:
    if "--measured" in arguments:
        RECORD.write_text(json.dumps(recorded(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    README.write_text(filled(README.read_text(encoding="utf-8"), contents()), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
