"""`workbench doctor`: what this machine has and lacks, each lack with the one command that mends it.

Always ends with status 0: what it finds is its result, not its failure.
"""

import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from workbench.extras import EXTRAS, install_command
from workbench.store import cache_folder, check_manifest

OLDEST_PYTHON = (3, 11)
ENOUGH_DISK = 5.0  # GB: an environment with torch and the simulator's compiled kernels
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "firefox", "msedge")
DRAWING_PATIENCE = 180.0  # seconds for the test picture, drawn in a process of its own


@dataclass(frozen=True)
class Check:
    """One thing looked for.  `mend` is the command that brings it, "" when it is there."""

    name: str
    found: str
    mend: str = ""

    @property
    def well(self) -> bool:
        return not self.mend


def run() -> list[Check]:
    """Look at everything; no check stops another."""
    return [
        python(),
        package("torch", "pip install -c constraints.txt torch"),
        package("warp", "pip install -c constraints.txt warp-lang"),
        cores(),
        drawing(),
        browser(),
        disk(cache_folder()),
        *(extra(name) for name in EXTRAS),
        assets(),
    ]


def report(checks: Sequence[Check]) -> str:
    """One line a check; below it, indented, the command that mends it."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{'ok ' if check.well else 'NO '} {check.name:<{width}}  {check.found}")
        if not check.well:
            lines.append(f"    {'':<{width}}  mend it with: {check.mend}")
    lacking = sum(not check.well for check in checks)
    lines.append("everything is here" if not lacking else f"{lacking} of {len(checks)} are missing")
    return "\n".join(lines)


def python() -> Check:
    found = f"{platform.python_version()} at {sys.executable}"
    wanted = ".".join(map(str, OLDEST_PYTHON))
    return Check("python", found, "" if sys.version_info >= OLDEST_PYTHON else f"apt-get install -y python{wanted}")


def package(module: str, mend: str) -> Check:
    """Import it for real: an installed library may still not load."""
    try:
        loaded = importlib.import_module(module)
    except (ImportError, OSError) as error:
        return Check(module, f"does not load: {_first_line(error)}", mend)
    return Check(module, str(getattr(loaded, "__version__", "installed")))


def cores() -> Check:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return Check("cores", f"{count} usable")


def drawing() -> Check:
    """VTK without a GL library kills its process, and workbench does not draw: widgets is asked from outside."""
    mend = "apt-get install -y libgl1 libegl1 libxrender1"
    command = [sys.executable, "-m", "widgets.gl"]
    try:
        probe = subprocess.run(command, capture_output=True, text=True, timeout=DRAWING_PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        return Check("drawing (GL)", f"a test picture took longer than {DRAWING_PATIENCE:g} s", mend)
    if probe.returncode == 0:
        return Check("drawing (GL)", "a test picture was drawn")
    return Check("drawing (GL)", (probe.stderr.strip().splitlines() or ["no message"])[-1], mend)


def browser(names: Sequence[str] = BROWSERS) -> Check:
    for name in names:
        path = shutil.which(name)
        if path:
            return Check("browser", path)
    return Check("browser", "none found; only interactive pages need one", "apt-get install -y chromium")


def disk(folder: Path, enough: float = ENOUGH_DISK) -> Check:
    """Free space where results are kept (or would be)."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    free = shutil.disk_usage(there).free / 1e9
    found = f"{free:.1f} GB free for {folder}"
    return Check("disk", found, "" if free >= enough else "export WORKBENCH_CACHE=/a/folder/on/a/larger/disk")


def extra(name: str) -> Check:
    absent = [module for module in EXTRAS[name] if importlib.util.find_spec(module) is None]
    if absent:
        return Check(f"extra {name}", f"lacks {', '.join(absent)}", install_command(name))
    return Check(f"extra {name}", "installed")


def assets(folder: Path = Path(__file__).parent / "assets") -> Check:
    manifest = folder / "manifest.json"
    if not manifest.is_file():
        return Check("assets", "no manifest.json", "python -m assets_gen all")
    try:
        faults = check_manifest(manifest)
    except ValueError as error:
        faults = [f"manifest.json is damaged: {_first_line(error)}"]
    if faults:
        return Check("assets", "; ".join(faults), "python -m assets_gen all")
    return Check("assets", "all files are those recorded")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
