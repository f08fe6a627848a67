"""One Chromium for the tests of a process.  Where there is none they are skipped; .ci/run installs it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from widgets.jupyterlab import NoChromium, browser, chromium, heard


@pytest.fixture(scope="session")
def shown_browser() -> Iterator[Any]:
    """A Chromium with WebGL by the processor."""
    try:
        chromium()
    except NoChromium as reason:
        pytest.skip(str(reason))
    with browser() as started:
        yield started


@pytest.fixture
def open_file(shown_browser):
    """Opens a page from a file.  An error on its console, or any request beyond the file, fails the test."""
    opened = []

    def opens(path: Path) -> Any:
        page = shown_browser.new_page(viewport={"width": 1400, "height": 900})
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        opened.append((page, heard(page), asked, path.as_uri()))
        page.goto(path.as_uri())
        return page

    yield opens
    for page, troubles, asked, address in opened:
        page.close()
        assert troubles == []
        assert [url for url in asked if url != address and not url.startswith(("data:", "blob:"))] == []
