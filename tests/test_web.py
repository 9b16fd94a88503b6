"""The page that samples in the browser, built by tools/web.py and driven in Chromium."""

import functools
import http.server
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.browser import CHROMIUM, Tab, browser
from support.fixtures import script
from support.glb import Glb

import flame_mdm
from flame_mdm.formats.readers import read

pytestmark = [
    pytest.mark.tools,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(CHROMIUM is None or shutil.which("npm") is None, reason="needs chromium and npm"),
]
TEXT = "a person kicks with the left foot twice"
DONE = "document.body?.dataset.made || document.querySelector('#notes.error')?.textContent"


class Handler(http.server.SimpleHTTPRequestHandler):
    extensions_map = http.server.SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript"}

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("web") / "page"
    script("tools/web.py").build("quickstart", out)
    return out


@pytest.fixture
def served(folder: Path, tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A copy of the page that a test may damage, and its address."""
    copy = tmp_path / "page"
    shutil.copytree(folder, copy)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(copy)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield copy, f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


def _wait_for(tab: Tab, file: Path) -> None:
    for _ in range(200):
        if file.exists():
            return
        tab.run("new Promise((done) => setTimeout(done, 50))")
    raise AssertionError(f"{file} was not downloaded")


def made(tab: Tab) -> dict[str, Any]:
    return json.loads(tab.wait(DONE, 120))


def test_the_page_samples_the_motions_of_the_package(served: tuple[Path, str], tmp_path: Path) -> None:
    folder, url = served
    assert sum(p.stat().st_size for p in folder.iterdir() if p.is_file()) <= 8e6
    model = flame_mdm.load("quickstart")
    with browser(tmp_path / "profile") as tab:
        tab.send("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        tab.open(f"{url}#text={TEXT}&seconds=2.2&seed=2")
        assert made(tab)["seed"] == "2"
        for seed in (0, 1, 2):
            tab.run("delete document.body.dataset.made")
            tab.type("#seed", str(seed))
            tab.click("#generate")
            assert made(tab) | {"milliseconds": 0} == {"text": TEXT, "seed": str(seed), "milliseconds": 0}
            expected = flame_mdm.generate(model, TEXT, seconds=2.2, seed=seed)[0]
            joints = np.array(tab.run("joints()")).reshape(expected.joints.shape)
            assert np.abs(joints - expected.joints).max() < 1e-3
        for ending in ("bvh", "glb"):
            tab.click(f"#{ending}")
            file = tmp_path / f"a-person-kicks-with-the-left-foot-twice.{ending}"
            _wait_for(tab, file)
            expected.save(tmp_path / f"python.{ending}")
        theirs, ours = read(file.with_suffix(".bvh")), read(tmp_path / "python.bvh")
        assert theirs.fps == pytest.approx(ours.fps)
        assert np.abs(theirs.joints - ours.joints).max() < 1e-3
        theirs, ours = (Glb(path).worlds()[:, :22, :3, 3] for path in (file, tmp_path / "python.glb"))
        assert np.abs(theirs - ours).max() < 0.01  # the proportions of its body are those of one example
        assert "seed=2" in tab.run("location.hash")
        tab.type("#text", "a person kicks backflipping")
        tab.click("#generate")
        assert "backflipping" in tab.wait("document.getElementById('notes').textContent")
        assert tab.run("document.querySelectorAll('#notes button').length") == 3
        tab.type("#text", "qwer asdf")
        tab.click("#generate")
        assert "knows no word" in tab.wait("document.querySelector('#notes.error')?.textContent")
        assert tab.errors == []
        assert [address for address in tab.requested if not address.startswith((url, "blob:", "data:"))] == []


@pytest.mark.parametrize(
    ("file", "change", "says"),
    [
        ("denoiser.onnx", lambda data: data[:-9] + b"x" * 9, "denoiser.onnx has changed since it was exported"),
        ("model.json", lambda data: data[:-9], "model.json is damaged: not JSON"),
        ("model.json", lambda data: data.replace(b"[[49.0,", b"[[49.0, 1,"), "model.json is damaged: steps"),
        ("figure.json", lambda data: data[:-9], "figure.json is damaged"),
    ],
)
def test_a_damaged_page_says_so_in_one_line(
    served: tuple[Path, str], tmp_path: Path, file: str, change: Any, says: str
) -> None:
    folder, url = served
    (folder / file).write_bytes(change((folder / file).read_bytes()))
    with browser(tmp_path / "profile") as tab:
        tab.open(url)
        assert says in tab.wait(DONE, 60)
