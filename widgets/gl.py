"""Whether this machine can draw: VTK without a GL library kills its process, so a child process tries first."""

import functools
import os
import subprocess
import sys

# Bare Debian and Ubuntu lack these; no display or xvfb is needed.
GL_COMMAND = "apt-get install -y libgl1 libegl1 libxrender1"
PROBE = (
    "import pyvista;"
    "plotter = pyvista.Plotter(off_screen=True, window_size=(32, 32));"
    "plotter.add_mesh(pyvista.Sphere(), color='red');"
    "raise SystemExit(0 if plotter.screenshot(None).std() > 1 else 3)"
)
PATIENCE = 120.0  # seconds; the first import of VTK from a cold disk is slow


class CannotDraw(RuntimeError):
    """There is no working GL; the message names the command that mends it."""


def prefer_display_free_rendering() -> None:
    """Without a display VTK first tries X and complains; EGL needs none."""
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")


@functools.cache
def fault() -> str:
    """Why this machine cannot draw, in one line; "" when it can.  Tried once a process."""
    prefer_display_free_rendering()
    try:
        probe = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, timeout=PATIENCE, text=True)
    except subprocess.TimeoutExpired:
        return f"a test picture took longer than {PATIENCE:g} s"
    if probe.returncode == 0:
        return ""
    if probe.returncode < 0:
        return f"a test picture ended its process (signal {-probe.returncode}): GL libraries are missing"
    if probe.returncode == 3:
        return "a test picture stayed empty"
    last = (probe.stderr.strip().splitlines() or ["no message"])[-1]
    return f"a test picture failed: {last}"


def ensure_can_draw() -> None:
    """Raises CannotDraw when there is no working GL."""
    reason = fault()
    if reason:
        raise CannotDraw(f"this machine cannot draw ({reason}): run {GL_COMMAND}")


if __name__ == "__main__":  # `workbench doctor` asks from outside, in a process of its own
    raise SystemExit(fault() or 0)
