"""Scene -> one HTML file: turns, plays and is read in a browser, without a kernel, a server or a network."""

import html
import json
from pathlib import Path

from widgets.frontend_bundle import bundled
from widgets.scene import Scene
from widgets.wire import as_base64, encode, packed
from workbench.store import atomic_write

LEAST_STEP = 1e-4  # metres: positions are within 0.05 mm, a fifth of the bytes of 16 full bits
ASPECT = 16 / 10  # of a browser window, for the first camera

SHELL = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
html, body {{ margin: 0; height: 100%; font: 14px/1.4 system-ui, sans-serif; color: #222; background: #f7f7f5; }}
body {{ display: flex; flex-direction: column; }}
h1 {{ font-size: 16px; margin: 8px 12px; }}
#view {{ flex: 1; min-height: 420px; }}
{style}
</style></head><body>
<h1>{title}</h1>
{above}
<div id="view"><noscript>This page is a 3-D view: it needs JavaScript.</noscript></div>
{below}
<script type="application/json" id="scene-header">{header}</script>
<script type="application/octet-stream" id="scene-arrays">{arrays}</script>
{more}
<script>{bundle}</script>
</body></html>
"""


def page(
    scene: Scene,
    title: str = "Garment workbench",
    *,
    above: str = "",
    below: str = "",
    style: str = "",
    script: str = "",
) -> str:
    """A whole HTML document.

    `above` and `below` are HTML around the view, `style` further CSS, `script` further JavaScript.  When the view is
    ready, the event "workbench-view" comes to `document`; its `detail` (also `window.workbenchView`) is the handle:
    setFrame(i), frame(), frames(), play(), pause(), onFrame(f), onPick(f), read(layer, vertex), pick(layer, vertex),
    isolateLayer(name or null), isolateRegion(layer, region or null), choose(layer, quantity), ghost(layer), png(),
    lookAt(layer, vertex, metres around it), nameFrames(one name a frame).

    Errors: NotBundled where the package was built without Node; ValueError as `widgets.wire.encode`.
    """
    header, blob = packed(encode(scene, ASPECT, LEAST_STEP))
    return SHELL.format(
        title=html.escape(title),
        above=above,
        below=below,
        style=style,
        header=json.dumps(header).replace("<", "\\u003c"),
        arrays=as_base64(blob),
        more=f"<script>{script}</script>" if script else "",
        bundle=bundled("page.js").replace("</script", "<\\/script"),
    )


def write_page(path: str | Path, scene: Scene, title: str = "Garment workbench", **around: str) -> Path:
    """Write the page, whole or not at all; `around` as `page`."""
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"a page is written as .html, not as {path.name}")
    document = page(scene, title, **around)
    with atomic_write(path) as part:
        part.write_text(document, encoding="utf-8")
    return path
