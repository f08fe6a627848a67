"""Where the bundled browser code is: name -> its text, or one line that says how to make it."""

import functools
from pathlib import Path

STATIC = Path(__file__).parent / "static"
BUNDLE_COMMAND = "python widgets/frontend/bundle.py"


class NotBundled(RuntimeError):
    """The package was built without Node or npm; the message names the command that makes the bundle."""


@functools.cache
def bundled(name: str) -> str:
    """The text of `view.js` or `page.js`.  Raises NotBundled where the build could not make it."""
    path = STATIC / name
    if not path.is_file():
        raise NotBundled(
            f"the browser views were not bundled when this package was built (npm was out of reach?): run "
            f"{BUNDLE_COMMAND} in the checkout, with network access"
        )
    return path.read_text(encoding="utf-8")
