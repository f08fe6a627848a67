"""A real JupyterLab with its default settings in a real Chromium, moved as by hand: for tests and timings of views.

Some faults show nowhere else: Jupyter runs widget callbacks in several threads, nbclient and nbmake do not, and what a
view draws is known only by its pixels.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CHROMIUM_COMMAND = "apt-get install -y chromium"
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
# WebGL by the processor: a bare machine has no graphics card
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")
PATIENCE = 180.0  # seconds, for a machine that other jobs keep busy
UNHEARD = 10.0  # seconds in which a cell that took the keys shows at least that it waits
NEVER_RUN = "[ ]:"  # the prompt of a cell

# Every drawing of a view whose pixels differ from the one before leaves its time; reading them back waits for them.
WATCH = """(root) => {
  const seen = { input: 0, changes: [] }, image = root.querySelector("img.wbv-stream");
  const canvas = root.querySelector(".wbv-picture > canvas"), changed = () => seen.changes.push(performance.now());
  if (image) image.addEventListener("load", changed);
  else {
    let last = null;
    new MutationObserver(() => {
      const gl = canvas.getContext("webgl2"), bytes = new Uint8Array(4 * canvas.width * canvas.height);
      gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      const pixels = new Uint32Array(bytes.buffer);
      if (!last || last.length !== pixels.length || pixels.some((pixel, i) => pixel !== last[i])) changed();
      last = pixels;
    }).observe(root, { attributes: true, attributeFilter: ["data-drawn"] });
  }
  for (const kind of ["pointermove", "pointerdown"])
    document.addEventListener(kind, (event) => (seen.input = event.timeStamp), true);
  window.watched = seen;
}"""


class NoChromium(RuntimeError):
    """There is no Chromium; the message names the command that mends it."""


def chromium() -> str:
    """Where Chromium is.  Raises NoChromium."""
    found = next((path for name in CHROMIUM_NAMES if (path := shutil.which(name))), None)
    if found is None:
        raise NoChromium(f"no Chromium on this machine: {CHROMIUM_COMMAND}")
    return found


@contextlib.contextmanager
def browser(*more: str) -> Iterator[Any]:
    """A Chromium without a window, `more` its switches; a new profile each time."""
    from playwright.sync_api import sync_playwright

    path = chromium()
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=[*SOFTWARE_GL, *more])
        try:
            yield started
        finally:
            started.close()


def heard(page: Any) -> list[str]:
    """What goes wrong in a page from now on: errors on its console, and those that nothing caught."""
    troubles: list[str] = []
    page.on("console", lambda said: troubles.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: troubles.append(str(error)))
    return troubles


@dataclass(frozen=True)
class JupyterLab:
    """A server; notebooks lie in `folder`."""

    folder: Path
    address: str
    token: str
    process: subprocess.Popen

    def kernels(self) -> list[Any]:
        """The kernels' processes (of psutil), oldest first."""
        import psutil

        inner = psutil.Process(self.process.pid).children(recursive=True)
        return sorted(
            (one for one in inner if any("ipykernel" in word for word in one.cmdline())),
            key=lambda one: one.create_time(),
        )


@contextlib.contextmanager
def jupyterlab(folder: Path) -> Iterator[JupyterLab]:
    """A server over `folder` on a free port, with no settings but Jupyter's own."""
    with tempfile.TemporaryDirectory() as home:
        runtime = Path(home) / "runtime"
        own = {
            "JUPYTER_CONFIG_DIR": f"{home}/config",
            "JUPYTER_DATA_DIR": f"{home}/data",
            "IPYTHONDIR": f"{home}/ipython",
        }
        words = ["--no-browser", "--ip=127.0.0.1", "--port=0", f"--ServerApp.root_dir={folder}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            words.append("--allow-root")
        with open(Path(home) / "log", "w+") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "jupyterlab", *words],
                env={**os.environ, **own, "JUPYTER_RUNTIME_DIR": str(runtime)},
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            try:
                yield JupyterLab(folder, *_address(process, runtime, Path(log.name)), process)
            finally:
                process.terminate()
                process.wait(PATIENCE)


def _address(process: subprocess.Popen, runtime: Path, log: Path) -> tuple[str, str]:
    """Where the server that has started is, and its token."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        for told in runtime.glob("jpserver-*.json"):
            with contextlib.suppress(json.JSONDecodeError):  # not written whole yet
                server = json.loads(told.read_text())
                return server["url"], server["token"]
        time.sleep(0.1)
    raise RuntimeError(f"JupyterLab did not start: {log.read_text()[-400:]}")


@dataclass(frozen=True)
class Notebook:
    """A notebook that is open in a page; `troubles` is what its console said."""

    page: Any
    troubles: list[str]

    def run(self, index: int, shows: str) -> Any:
        """Run a cell and wait until its output has what the selector `shows` names; that element.

        Errors: RuntimeError with the cell's own error.
        """
        cell = self.page.locator(".jp-CodeCell").nth(index)
        self._press(cell)
        shown = cell.locator(shows)
        fault = cell.locator('[data-mime-type="application/vnd.jupyter.error"], [data-mime-type*="stderr"]')
        shown.or_(fault).first.wait_for(state="attached", timeout=1e3 * PATIENCE)
        if fault.count():
            raise RuntimeError(f"cell {index} ended in: {fault.first.inner_text()[-800:]}")
        return shown.first

    def _press(self, cell: Any) -> None:
        """Ctrl+Enter in a cell; again if it never ran and shows no sign: a dialog may have taken the keys."""
        from playwright.sync_api import expect

        prompt = cell.locator(".jp-InputPrompt").first
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            cell.locator(".jp-InputArea-editor").click()
            first_run = prompt.inner_text().strip() == NEVER_RUN
            self.page.keyboard.press("Control+Enter")
            if not first_run:
                return  # its old number may be its new one, after a restart: nothing to tell them by
            with contextlib.suppress(AssertionError):
                expect(prompt).not_to_have_text(NEVER_RUN, timeout=1e3 * UNHEARD)
                return


def open_notebook(page: Any, lab: JupyterLab, name: str, cells: list[str]) -> Notebook:
    """Write a notebook of these cells, open it as a person would, and wait for its kernel."""
    made = {
        "nbformat": 4,
        "nbformat_minor": 5,
        "metadata": {"kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"}},
        "cells": [
            {"id": f"c{i}", "cell_type": "code", "metadata": {}, "execution_count": None, "outputs": [], "source": cell}
            for i, cell in enumerate(cells)
        ],
    }
    (lab.folder / f"{name}.ipynb").write_text(json.dumps(made))
    troubles = heard(page)
    page.add_locator_handler(page.locator(".jp-Dialog"), _answer_dialog)
    page.add_locator_handler(
        page.locator(".jp-toastContainer button", has_text="No"), lambda no: no.first.dispatch_event("click")
    )
    page.goto(f"{lab.address}lab/tree/{name}.ipynb?token={lab.token}", timeout=1e3 * PATIENCE)
    idle = '.jp-NotebookPanel:not(.lm-mod-hidden) .jp-Notebook-ExecutionIndicator[data-status="idle"]'
    page.locator(idle).first.wait_for(state="visible", timeout=1e3 * PATIENCE)
    return Notebook(page, troubles)


def _answer_dialog(dialog: Any) -> None:
    """A kernel is wanted; nothing else that JupyterLab offers is (open3d's Dash asks for a build)."""
    refuse, accept = dialog.first.locator(".jp-mod-reject"), dialog.first.locator(".jp-mod-accept")
    wanted = "Select Kernel" in dialog.first.inner_text() or not refuse.count()  # some only tell
    (accept if wanted else refuse).first.dispatch_event("click")  # at once: a busy machine animates slowly


@dataclass(frozen=True)
class Watched:
    """A view whose changes of pixels leave their times (ms of the page's clock); one at a time in a page."""

    page: Any

    @staticmethod
    def of(view: Any) -> "Watched":
        """Watch the view that a locator finds, from now on."""
        view.evaluate(WATCH)
        return Watched(view.page)

    def changes(self) -> list[float]:
        return self.page.evaluate("watched.changes")

    def delay(self, act: Callable[[], None]) -> float:
        """Milliseconds from the hand's move that `act` makes to the first change of pixels after it."""
        self.page.evaluate("watched.changes.length = 0")
        act()
        self.page.wait_for_function("watched.changes.length", timeout=1e3 * PATIENCE)
        return float(self.page.evaluate("watched.changes[0] - watched.input"))

    def settle(self) -> None:
        """Wait until nothing is on its way any more: no change for a third of a second."""
        self.page.wait_for_function(
            "performance.now() - Math.max(watched.input, ...watched.changes) > 330", timeout=1e3 * PATIENCE
        )


def grab(page: Any, handle: Any) -> tuple[float, float]:
    """Press the mouse on an element, and leave it pressed; where that is."""
    handle.scroll_into_view_if_needed()
    box = handle.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    return x, y


def page_megabytes(page: Any) -> float:
    """What the page's scripts hold, buffers and elements counted, after a collection of garbage."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    heap = session.send("Runtime.getHeapUsage")
    session.detach()
    return sum(heap.get(part, 0) for part in ("usedSize", "embedderHeapUsedSize", "backingStorageSize")) / 1e6


def renderer_megabytes(browser: Any) -> float:
    """What the processes that show pages hold in memory, in all."""
    import psutil

    session = browser.new_browser_cdp_session()
    told = session.send("SystemInfo.getProcessInfo")["processInfo"]
    session.detach()
    return sum(psutil.Process(one["id"]).memory_info().rss for one in told if one["type"] == "renderer") / 1e6
