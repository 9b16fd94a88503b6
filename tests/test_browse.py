import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.motions import HOSTILE, Page, unpacked

from flame_mdm.__main__ import main
from flame_mdm.data import Clip, MotionSource
from flame_mdm.data.store import Entry, Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.readers import read
from flame_mdm.reporting.browse import choose, describe, find, motion, write_clips, write_page
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D

SYNTHETIC = ["data=synthetic", "data.source.clips=60"]


def entry(name: str, split: str = "train", *captions: str, length: int = 40) -> Entry:
    return Entry(name, 0, length, split, name.lstrip("M"), list(captions), None)  # type: ignore[arg-type]


def names(families: list[list[Entry]]) -> list[list[str]]:
    return [[clip.id for clip in family] for family in families]


ENTRIES = [
    entry("Ma", "train", "waves the left hand"),
    entry("a", "train", "waves the right hand"),
    entry("b", "val", "Kicks twice"),
    entry("March", "train", "marches"),  # no mirrored copy: there is no clip called arch
    entry("c", "train"),
    entry("Mc", "train"),
]


def test_mirrored_copies_stand_beside_their_originals():
    assert names(find(ENTRIES, None, "")) == [["a", "Ma"], ["b"], ["March"], ["c", "Mc"]]


@pytest.mark.parametrize(
    ("split", "search", "found"),
    [
        ("val", "", [["b"]]),
        ("train", "kicks", []),
        (None, "TWICE kicks", [["b"]]),
        (None, "left waves", [["a", "Ma"]]),
        (None, "left right", []),
        (None, "mc", [["c", "Mc"]]),
    ],
)
def test_search_and_split(split, search, found):
    assert names(find(ENTRIES, split, search)) == found


def test_clips_are_chosen_evenly_and_not_too_many():
    families = [[entry(f"{k}"), entry(f"M{k}")] if k % 2 else [entry(f"{k}")] for k in range(100)]
    for most in (1, 2, 7, 50, 149, 150, 1000):
        chosen = choose(families, most)
        count = sum(map(len, chosen))
        assert min(most, 150) * 0.5 <= count <= most
        assert chosen[0] == families[0]
        gaps = np.diff([int(family[0].id) for family in chosen])
        assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1
    assert choose(families, 150) == families
    assert choose([families[1]], 1) == [families[1]]


class Hostile(MotionSource):
    """Five clips with markup in every text, one of them longer than the page shows, one mirrored."""

    name = HOSTILE
    actions = (HOSTILE,)

    def count(self) -> int:
        return 5

    def __init__(self) -> None:
        self.excluded[HOSTILE] = 3

    def clips(self, fps: float) -> Iterator[Clip]:
        walk = next(Synthetic(clips=1).clips(fps)).motion
        for number in range(4):
            shown = np.concatenate([walk] * 8) if number == 3 else walk
            yield Clip(f"{number}{HOSTILE}", shown, [HOSTILE, "walks"], "train" if number else "val", f"{number}", 0)
        yield Clip(f"M3{HOSTILE}", walk, [], "train", "3", 0)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return write_store(tmp_path_factory.mktemp("browse") / "hostile", Hostile(), HumanML())


def page_of(store: Store, path: Path) -> Page:
    families = find(store.clips, None, "")
    write_page(path, store, HumanML(), [clip for family in families for clip in family], HOSTILE)
    return Page(path)


def test_texts_are_escaped(store, tmp_path):
    page = page_of(store, tmp_path / "p.html")
    assert page.tags.count("script") == 3
    assert not {"img", "link", "iframe"} & set(page.tags)
    texts = " ".join(page.texts.values())
    assert texts.count(HOSTILE) >= 5  # title, heading, data set, what was left out, actions


def test_page_holds_every_clip(store, tmp_path):
    page = page_of(store, tmp_path / "p.html")
    assert [m["id"] for m in page.motions] == [*(f"{k}{HOSTILE}" for k in range(4)), f"M3{HOSTILE}"]
    assert [m["group"] for m in page.motions] == ["val", "train", "train", "train", "train"]
    assert page.motions[4]["beside"] == page.motions[3]["id"]
    assert page.motions[0]["caption"] == f"{HOSTILE} · walks"
    assert page.motions[4]["caption"] == HOSTILE  # no captions: the action
    clip = store.clips[0]
    joints = HumanML().decode(torch.from_numpy(store.motion(clip).copy())).numpy()
    np.testing.assert_allclose(unpacked(page.motions[0]), joints, atol=6e-4)
    assert page.motions[3]["frames"] == 300  # 15 seconds
    assert "(the first 15 of" in page.motions[3]["caption"]


def test_statistics_count_all_clips_whether_shown_or_not(store):
    about = describe(store)
    lengths = [clip.length for clip in store.clips if clip.split == "train"]
    minutes = f"{sum(lengths) / 20 / 60:.1f}"
    cells = [4, minutes, min(lengths), f"{np.median(lengths):g}", max(lengths), 6, 2]
    assert "<tr><td>train</td>" + "".join(f'<td class="number">{cell}</td>' for cell in cells) in about
    assert '<tr><td>val</td><td class="number">1</td>' in about
    bars = [note.split("</title>")[0] for note in about.split("<title>")[1:]]
    for split, count in (("train", 4), ("val", 1)):
        assert sum(int(bar.split(": ")[1].split()[0]) for bar in bars if bar.endswith(split)) == count


def test_motions_without_a_floor_stand_on_one(tmp_path):
    class Falling(MotionSource):
        """A body in the camera's coordinates."""

        name = "falling"

        def count(self) -> int:
            return 1

        def clips(self, fps: float) -> Iterator[Clip]:
            yield Clip("a", np.zeros((9, 75), np.float32), [], "train", "a")

    representation = Rot6D()
    store = write_store(tmp_path / "falling", Falling(), representation)
    shown = motion(store, representation, store.clips[0])
    assert shown.joints[..., 1].min() == pytest.approx(0, abs=1e-6)


def run(tmp_path: Path, data_root: Path, *words: str) -> int:
    return main(["browse", *SYNTHETIC, f"data_root={data_root}", f"out={tmp_path / 'page.html'}", *words])


def test_command_prepares_and_shows(tmp_path, data_root, capsys):
    assert run(tmp_path, data_root, "clips=10") == 0
    assert "page.html: 10 of 60 clips" in capsys.readouterr().out
    page = Page(tmp_path / "page.html")
    assert len(page.motions) == 10
    assert page.texts["h1"] == "synthetic: 10 of 60 clips"
    assert run(tmp_path, data_root, "split=train", "search=it's ${a} person") == 1
    assert run(tmp_path, data_root, "split=train", "search=walks") == 0
    page = Page(tmp_path / "page.html")
    assert page.motions
    assert all("walks" in m["caption"] and m["group"] == "train" for m in page.motions)


def test_shown_clips_are_written_as_motion_files(tmp_path, data_root, capsys):
    folder = tmp_path / "real motions"
    assert run(tmp_path, data_root, "split=test", "clips=4", f"motions={folder}") == 0
    page = Page(tmp_path / "page.html")
    files = sorted(folder.glob("*.npz"))
    assert [path.name for path in files] == [f"motion_{n:03d}_{m['id']}.npz" for n, m in enumerate(page.motions)]
    for path, shown in zip(files, page.motions, strict=True):
        found = read(path)
        assert found.fps == 20
        assert len(found.joints) == min(shown["frames"], 60), "cut as for evaluation"
        assert found.text
        assert found.text in shown["caption"].split(" · ")
        with np.load(path) as file:
            assert str(file["clip"]) == shown["id"]
            np.testing.assert_allclose(
                HumanML().decode(torch.from_numpy(file["features"])).numpy(), file["joints"], atol=1e-6
            )
    assert run(tmp_path, data_root, "split=test", "clips=1", f"motions={folder}") == 1
    assert "holds other motions, such as motion_001_" in capsys.readouterr().err


def test_a_caption_names_one_motion_where_it_can(store, tmp_path):
    by_id = {clip.id: clip for clip in store.clips}
    clips = [by_id[f"{number}{HOSTILE}"] for number in range(3)]
    copy = by_id[f"M3{HOSTILE}"]  # has a label only
    write_clips(tmp_path, store, HumanML(), [*clips, copy, replace(copy, action=None)], 30)
    captions = [read(path).text for path in sorted(tmp_path.glob("*.npz"))]
    assert captions == [HOSTILE, "walks", HOSTILE, HOSTILE, ""]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["split=dev"], "no split is called dev. Available: train, val, test"),
        (["search=swims"], "'swims' in its id or captions"),
    ],
)
def test_command_says_what_is_wrong(tmp_path, data_root, capsys, words, message):
    assert run(tmp_path, data_root, *words) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


def test_command_names_the_data_sets(capsys):
    assert (
        main(
            [
                "browse",
            ]
        )
        == 1
    )
    assert "data=NAME, one of: " in capsys.readouterr().err


def test_own_data_are_shown_by_their_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walk = next(Synthetic(clips=1).clips(20.0)).motion
    Path("files").mkdir()
    for name in ("a", "b"):
        np.save(Path("files") / f"{name}.npy", walk)
    (Path("files") / "skeleton.yaml").write_text("fps: 20\n")
    (Path("files") / "captions.csv").write_text("id,text,split\na,a person walks,train\nb,a person walks,test\n")
    assert main(["browse", "data=folder", "source=files", "data.name=my set", "data.source.mirror=true"]) == 0
    shutil.rmtree("files")  # a prepared set is enough from here on
    assert main(["browse", "my set", "page.html"]) == 0
    assert [m["id"] for m in Page(Path("page.html")).motions] == ["a", "Ma", "b"], "with the options of its preparation"
    capsys.readouterr()
    assert main(["browse", "data=my set", "source=files", "out=page.html"]) == 0
    assert "already prepared; source=files is not read" in capsys.readouterr().out
    shutil.copytree("data/my set-humanml-clean-smpl22", "data/my set-smpl147")
    assert main(["browse", "data=my set"]) == 1
    assert "data=my set was prepared as humanml_clean and as smpl. Add rep" in capsys.readouterr().err
    assert main(["browse", "data=my set", "representation=humanml_clean"]) == 0
    assert main(["browse", "data=my"]) == 1
    assert "no data is called 'my'" in capsys.readouterr().err


@pytest.mark.tools
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_page_narrows_down_in_a_browser(store, tmp_path):
    page_of(store, tmp_path / "page.html")
    page = tmp_path / "page.html"
    report = """<script>setTimeout(() => {
      const ids = () => shown().map((m) => motions.indexOf(m)), seen = {};
      const choose = (id, value, kind) => { element(id).value = value; element(id).dispatchEvent(new Event(kind)); };
      seen.groups = [...element("group").options].map((o) => o.value);
      choose("group", "val", "change"); seen.val = ids(); seen.count = element("count").textContent;
      choose("group", "", "change");
      choose("filter", "walks 3", "input"); seen.search = ids(); // the copy has no such caption, but comes along
      choose("filter", "", "input"); seen.all = ids();
      seen.columns = motions.map((m) => +m.figure.style.gridColumnStart);
      seen.each = element("each").checked;
      const pre = Object.assign(document.createElement("pre"), { id: "seen", textContent: JSON.stringify(seen) });
      document.body.append(pre);
    }, 300)</script></body>"""
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", report), encoding="utf-8")
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage"]
    command += ["--disable-background-networking", f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1000,500"]
    command += ["--virtual-time-budget=1500", "--dump-dom", page.as_uri()]
    dump = subprocess.run(command, capture_output=True, check=True, timeout=60).stdout.decode()
    (tmp_path / "dump.html").write_text(dump, encoding="utf-8")
    seen = json.loads(Page(tmp_path / "dump.html").texts["seen"])
    assert seen["groups"] == ["", "val", "train"]
    assert seen["val"] == [0]
    assert seen["count"] == "1 of 5"
    assert seen["search"] == [3, 4]
    assert seen["all"] == [0, 1, 2, 3, 4]
    assert seen["each"]
    assert seen["columns"][4] == seen["columns"][3] + 1  # a copy beside its original
