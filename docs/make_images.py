"""All pictures of the documentation, made anew from what the program does now.

    python -m docs.make_images [NAME.png ...]

Without names it makes all, which takes some twenty minutes of one core; those of ``walls.png`` are
fifteen. The picture of the scope needs Chromium and its driver; look at what has changed.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image, ImageChops

DOCS = Path(__file__).parent
IMAGES = DOCS / "images"
GALLERY = DOCS.parent / "examples" / "gallery"
_WORN = ("friction: none", "friction: cyclic")  # brushes of the free shaft's rig
_SIZE = (1300, 1290)  # pixels of the scope's page
_LOADED = "return window.Bokeh?.documents?.[0]?.get_model_by_name('samples')?.data.t?.length ?? 0"
_FIGURE = """
const named = Bokeh.documents[0].get_model_by_name('figure of torque')
return Bokeh.index.find_one(named).el.getBoundingClientRect().toJSON()
"""


_UNMARKED = """
let marked = document.activeElement
while (marked?.shadowRoot?.activeElement) marked = marked.shadowRoot.activeElement
marked?.blur()
"""


def rig(folder: Path, *words: str) -> None:
    """Run a command of ``rig`` in a folder."""
    subprocess.run([sys.executable, "-m", "daq.cli", *words, "--quiet"], cwd=folder, check=True)


def checked(protocol: str, folder: Path) -> Path:
    """Waveforms and spectra of a shipped experiment."""
    rig(folder, "check", protocol, "--plot", "check.png")
    return folder / "check.png"


def measured(protocol: str, figure: str, folder: Path) -> Path:
    """A figure among the results of a shipped experiment on its simulated rig."""
    rig(folder, "run", protocol)
    return _result(folder, figure)


def worn(folder: Path) -> Path:
    """Torque along the turn of a shaft with worn brushes."""
    text = (DOCS.parent / "sim_rig" / "free_shaft.yaml").read_text()
    (folder / "worn.yaml").write_text(text.replace(*_WORN))
    rig(folder, "run", "constant_velocity.yaml", "--rig", "worn.yaml")
    return _result(folder, "torque_angle")


def _result(folder: Path, figure: str) -> Path:
    (path,) = folder.glob(f"runs/*/results/{figure}.png")
    return path


def identified(figure: str, folder: Path) -> Path:
    """A figure of an identification."""
    rig(folder, "run", "prbs.yaml", "--identify")
    (result,) = folder.glob("runs/*/identification")
    rig(folder, "figures", str(result), "--format", "png")
    return result / "figures" / f"{figure}.png"


def walls(folder: Path) -> Path:
    """The stiffest walls."""
    words = ["--measure", "800", "--plot", str(folder / "walls.png")]
    words = [sys.executable, "-m", "benchmarks.walls", *words]
    subprocess.run(words, cwd=DOCS.parent, check=True)
    return folder / "walls.png"


def gallery(folder: Path) -> Path:
    """The gallery's systems; writes its table, too."""
    subprocess.run([sys.executable, str(GALLERY / "make.py")], cwd=folder, check=True)
    return GALLERY / "gallery.png"


def scope(folder: Path) -> Path:
    """The scope's page on a run, a mark set and the cursor elsewhere."""
    rig(folder, "run", "prbs.yaml")
    words = [sys.executable, "-m", "daq.cli", "scope", "--no-browser", "--port", "0"]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            _photograph(process.stdout.readline().split()[0], folder / "scope.png")
        finally:
            process.terminate()
    return folder / "scope.png"


def _photograph(address: str, path: Path) -> None:
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.common.actions.action_builder import ActionBuilder

    options: Any = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    size = f"--window-size={_SIZE[0]},{_SIZE[1]}"
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", size):
        options.add_argument(argument)
    with webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver"))) as page:
        page.get(address)
        while page.execute_script(_LOADED) == 0:
            time.sleep(0.2)
        time.sleep(3.0)  # until all is painted
        area = page.execute_script(_FIGURE)
        middle = round(area["y"] + area["height"] / 2.0)
        actions = ActionBuilder(page)
        actions.pointer_action.move_to_location(round(area["x"] + 250.0), middle).click()
        actions.pointer_action.move_to_location(round(area["x"] + 500.0), middle)
        actions.perform()
        page.execute_script(_UNMARKED)
        time.sleep(2.0)
        page.save_screenshot(str(path))


PICTURES: dict[str, Callable[[Path], Path]] = {
    "chirp.png": partial(checked, "chirp.yaml"),
    "multisine.png": partial(checked, "multisine.yaml"),
    "steps.png": partial(checked, "steps.yaml"),
    "hysteresis_loop.png": partial(measured, "hysteresis_loop.yaml", "torque_angle"),
    "torque_velocity.png": partial(measured, "constant_velocity.yaml", "torque_velocity"),
    "torque_angle.png": worn,
    "z_width.png": partial(measured, "virtual_wall.yaml", "z_width"),
    "identification.png": partial(identified, "validation"),
    "scope.png": scope,
    "walls.png": walls,
    "gallery.png": gallery,
}


def save(made: Path, path: Path) -> None:
    """Keep a picture in 256 colors, a third of the bytes; one that looks the same stays."""
    picture = Image.open(made).convert("RGB").quantize(256)
    if path.exists():
        before = Image.open(path).convert("RGB")
        after = picture.convert("RGB")
        if before.size == after.size and ImageChops.difference(before, after).getbbox() is None:
            return
    picture.save(path, optimize=True)


def main() -> None:
    """Make those that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else "")
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], metavar="NAME.png")
    for name in parser.parse_args().names or PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            made = PICTURES[name](Path(folder))
            if made.parent != GALLERY:
                save(made, IMAGES / name)
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
