"""The page that shows a data set: which clips, what it says of them, and nothing from them that runs."""

from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.browser import CHROMIUM, browser
from support.motions import HOSTILE, Page, synthetic, unpacked
from support.runs import TINY
from support.stores import OwnClips

from flame_mdm.__main__ import main
from flame_mdm.data import Clip
from flame_mdm.data.store import Entry, Store, write_store
from flame_mdm.formats.readers import read
from flame_mdm.reporting import browse
from flame_mdm.reporting.browse import choose, describe, find, motion, write_clips, write_page
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22


def entry(name: str, split: str = "train", *captions: str) -> Entry:
    return Entry(name, 0, 40, split, name.lstrip("M"), list(captions), None)  # type: ignore[arg-type]


def test_clips_are_found_by_words_and_split_with_their_mirrored_copies(subtests):
    # No clip matches the search for arch.
    entries = [
        *(entry("Ma", "train", "waves the left hand"), entry("a", "train", "waves the right hand")),
        *(
            entry("b", "val", "Kicks twice"),
            entry("March", "train", "marches"),
            entry("c"),
            entry("Mc"),
        ),
    ]
    for split, search, expected in (
        (None, "", [["a", "Ma"], ["b"], ["March"], ["c", "Mc"]]),
        ("val", "", [["b"]]),
        ("train", "kicks", []),
        (None, "TWICE kicks", [["b"]]),
        (None, "left waves", [["a", "Ma"]]),
        (None, "left right", []),
        (None, "mc", [["c", "Mc"]]),
    ):
        with subtests.test(split=split, search=search, expected=expected):
            assert [
                [clip.id for clip in family] for family in find(entries, split, search)
            ] == expected, (split, search)


def test_clips_are_chosen_evenly_and_not_too_many(subtests):
    families = [[entry(f"{k}"), entry(f"M{k}")] if k % 2 else [entry(f"{k}")] for k in range(100)]
    for most in (1, 2, 7, 50, 149, 150, 1000):
        with subtests.test(most=most):
            chosen = choose(families, most)
            assert min(most, 150) * 0.5 <= sum(map(len, chosen)) <= most
            assert chosen[0] == families[0]
            gaps = np.diff([int(family[0].id) for family in chosen])
            assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1
    assert choose(families, 150) == families
    assert choose([families[1]], 1) == [families[1]]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Five clips with markup in every text, one of them longer than the page shows, one mirrored."""
    walk = synthetic().joints
    texts = [HOSTILE, "walks"]
    clips = [
        Clip(f"{k}{HOSTILE}", walk, texts, "train" if k else "val", f"{k}", 0) for k in range(3)
    ]
    clips.append(Clip(f"3{HOSTILE}", np.concatenate([walk] * 8), texts, "train", "3", 0))
    source = OwnClips(*clips, Clip(f"M3{HOSTILE}", walk, [], "train", "3", 0))
    source.name, source.actions = HOSTILE, (HOSTILE,)
    source.excluded[HOSTILE] = 3
    return write_store(tmp_path_factory.mktemp("browse") / "hostile", source, HumanML())


def page_of(store: Store, path: Path) -> Page:
    write_page(path, store, HumanML(), list(chain(*find(store.clips, None, ""))), HOSTILE, None)
    return Page(path)


def test_a_page_shows_every_clip_and_its_texts_as_text(store, tmp_path):
    page = page_of(store, tmp_path / "p.html")
    assert page.tags.count("script") == 3
    assert not {"img", "link", "iframe"} & set(page.tags)
    # The hostile text is in title, heading, data set, reasons and actions.
    assert " ".join(page.texts.values()).count(HOSTILE) >= 5
    assert [m["id"] for m in page.motions] == [*(f"{k}{HOSTILE}" for k in range(4)), f"M3{HOSTILE}"]
    assert [m["group"] for m in page.motions] == ["val", "train", "train", "train", "train"]
    assert page.motions[4]["beside"] == page.motions[3]["id"]
    assert page.motions[0]["caption"] == f"{HOSTILE} · walks"
    assert page.motions[4]["caption"] == HOSTILE  # no captions: the action
    joints = HumanML().decode(torch.from_numpy(store.motion(store.clips[0]).copy())).numpy()
    np.testing.assert_allclose(unpacked(page.motions[0]), joints, atol=6e-4)
    assert page.motions[3]["frames"] == 300  # 15 seconds
    assert "(the first 15 of" in page.motions[3]["caption"]
    about = describe(store)  # of all clips
    lengths = [clip.length for clip in store.clips if clip.split == "train"]
    cells = [
        4,
        f"{sum(lengths) / 20 / 60:.1f}",
        min(lengths),
        f"{np.median(lengths):g}",
        max(lengths),
        6,
        2,
    ]
    assert (
        "<tr><td>train</td>" + "".join(f'<td class="number">{cell}</td>' for cell in cells) in about
    )
    assert '<tr><td>val</td><td class="number">1</td>' in about


def test_the_command_shows_what_is_searched_and_writes_it(tmp_path, data_root, capsys, subtests):
    out = tmp_path / "page.html"

    def run(*words: str) -> int:
        return main(
            ["browse", "data=synthetic", TINY[0], f"data_root={data_root}", f"out={out}", *words]
        )

    assert run("clips=10") == 0
    assert "page.html: 10 of 120 clips" in capsys.readouterr().out
    page = Page(out)
    assert (len(page.motions), page.texts["h1"]) == (10, "synthetic: 10 of 120 clips")
    assert run("split=train", "search=walks") == 0
    assert {("walks" in m["caption"], m["group"]) for m in Page(out).motions} == {(True, "train")}
    count = len(Page(out).motions)
    assert Page(out).texts["h1"] == f"synthetic: {count} of {count} clips in train with 'walks'"
    size = f"{out.stat().st_size / 1e6:.1f} MB"
    assert f"page.html: {count} of {count} clips, {size}" in capsys.readouterr().out

    folder = tmp_path / "real motions"
    assert run("split=test", "clips=4", f"motions={folder}") == 0
    motions, files = Page(out).motions, sorted(folder.glob("*.npz"))
    assert [path.name for path in files] == [
        f"motion_{n:03d}_{m['id']}.npz" for n, m in enumerate(motions)
    ]
    for path, shown in zip(files, motions, strict=True):
        with subtests.test(clip=shown["id"]):
            file = read(path)
            assert (file.fps, len(file.joints)) == (20, min(shown["frames"], 60)), (
                "cut as for evaluation"
            )
            assert file.text
            assert file.text in shown["caption"].split(" · ")
            with np.load(path) as arrays:
                assert str(arrays["clip"]) == shown["id"]
                decoded = HumanML().decode(torch.from_numpy(arrays["features"])).numpy()
                np.testing.assert_allclose(decoded, arrays["joints"], atol=1e-6)

    assert run("split=test", "clips=1", f"motions={folder}") == 1
    assert "contains other motions, such as motion_001_" in capsys.readouterr().err


@pytest.mark.tools
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_page_narrows_down_in_a_browser(store, tmp_path, subtests):
    page_of(store, tmp_path / "page.html")
    with browser(tmp_path / "profile", 1000, 500) as tab:
        tab.open((tmp_path / "page.html").as_uri())
        tab.wait("typeof motions === 'object' && motions.length === 5 && !!motions[4].figure")
        assert tab.run("[...element('group').options].map((o) => o.value)") == ["", "val", "train"]
        for field, value, event, shown in (
            ("group", "val", "change", [0]),
            ("group", "", "change", [0, 1, 2, 3, 4]),
            ("filter", "walks 3", "input", [3, 4]),  # the copy has no such caption, but comes along
            ("filter", "", "input", [0, 1, 2, 3, 4]),
        ):
            with subtests.test(field=field, value=value):
                tab.run(
                    f"element('{field}').value = '{value}'; element('{field}').dispatchEvent(new Event('{event}'))"
                )
                assert tab.run("shown().map((m) => motions.indexOf(m))") == shown, value
                assert tab.run("element('count').textContent") == (
                    "" if len(shown) == 5 else f"{len(shown)} of 5"
                )
        assert tab.run("element('each').checked")
        columns = tab.run("motions.map((m) => +m.figure.style.gridColumnStart)")
        assert columns[4] == columns[3] + 1  # a copy beside its original


class Raw:
    """A representation whose features are the joint positions."""

    fps, skeleton, name = 20.0, SMPL22, "raw"

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        return x.unflatten(-1, (22, 3))

    def rebase(self, x: np.ndarray) -> np.ndarray:
        return x


def stored(*motions: np.ndarray, captions: list[list[str]], action: int | None = None) -> Any:
    """A store of clips with these motions (F, 22, 3) and captions."""
    clips = [
        Entry(f"clip/{number}", 0, len(x), "train", f"{number}", texts, action)
        for number, (x, texts) in enumerate(zip(motions, captions, strict=True))
    ]
    by_id = {clip.id: x.reshape(len(x), 66) for clip, x in zip(clips, motions, strict=True)}
    info = {"actions": ["walk", "run"], "fps": 20.0, "clips": {"train": len(clips), "val": 0}}
    return SimpleNamespace(
        clips=clips, info=info, fingerprint="f00d", motion=lambda clip: by_id[clip.id]
    )


def test_the_first_fifteen_seconds_are_shown_on_the_floor():
    body = np.random.default_rng(0).uniform(0, 1, (320, 22, 3)).astype(np.float32)
    body[..., 1] -= body[..., 1].min()
    for height, lowest in ((-0.29, -0.29), (-0.31, 0.0), (0.5, 0.5)):
        lifted = body + np.array([0, height, 0], np.float32)
        lifted[310:] -= 5.0  # past what is shown
        store = stored(lifted, captions=[["walks", "goes"]])
        shown = motion(store, cast(Any, Raw()), store.clips[0])
        assert len(shown.joints) == 300
        assert shown.joints[..., 1].min() == pytest.approx(
            lifted[:300, :, 1].min() if lowest else 0, abs=1e-5
        )
        assert shown.text == "walks · goes (the first 15 of 16 s)"
    short = stored(body[:300], captions=[[]], action=1)
    assert motion(short, cast(Any, Raw()), short.clips[0]).text == "run"


def test_written_clips_have_different_captions_and_the_length_of_evaluations(tmp_path):
    bodies = [np.random.default_rng(number).uniform(0, 1, (50, 22, 3)) for number in range(4)]
    texts = [["walks", "goes"], ["walks", "goes"], ["walks"], []]
    store = stored(*[body.astype(np.float32) for body in bodies], captions=texts, action=0)
    write_clips(tmp_path / "out", store, cast(Any, Raw()), store.clips, 40)
    files = sorted((tmp_path / "out").glob("*.npz"))
    assert [file.name for file in files] == [f"motion_{n:03d}_clip_{n}.npz" for n in range(4)]
    contents = [np.load(file) for file in files]
    assert [str(content["text"]) for content in contents] == ["walks", "goes", "walks", "walk"]
    assert {len(content["joints"]) for content in contents} == {40}
    assert (str(contents[0]["clip"]), str(contents[0]["data"])) == ("clip/0", "f00d")


def test_a_data_set_is_described_by_its_minutes_lengths_and_words(monkeypatch):
    seen: dict[str, Any] = {}
    monkeypatch.setattr(browse, "render", lambda _, **values: seen.update(values))
    bodies = [np.zeros((frames, 22, 3), np.float32) for frames in (600, 1200, 900)]
    texts = [["walks on", "walks on"], ["jumps"], []]
    store = stored(*bodies, captions=texts, action=1)
    describe(store)
    # clips, minutes, frames (shortest, median, longest), captions, different ones, words of each
    assert seen["rows"] == [["train", 3, "2.2", 600, "900", 1200, 3, 2, "1.7"]]
    assert seen["actions"] == [("run", 3)]


@pytest.mark.parametrize(("fps", "frames"), [(12.5, 188), (20.0, 300), (30.0, 450)])
def test_a_page_shows_fifteen_seconds_at_any_frame_rate(fps: float, frames: int):
    body = np.random.default_rng(0).uniform(0, 1, (600, 22, 3)).astype(np.float32)
    store = stored(body, captions=[["walks"]])
    raw: Any = Raw()
    raw.fps = fps
    shown = motion(store, raw, store.clips[0])
    assert (len(shown.joints), shown.fps) == (frames, fps)
    assert shown.text == f"walks (the first 15 of {600 / fps:.0f} s)"


def test_a_mirrored_copy_belongs_to_its_original_even_if_that_is_in_another_split():
    entries = [entry("Ma", "train", "waves"), entry("a", "val", "waves")]
    assert [[clip.id for clip in family] for family in find(entries, None, "")] == [["a", "Ma"]]
    assert [[clip.id for clip in family] for family in find(entries, "train", "")] == [["Ma"]]


def test_clips_are_cut_before_they_are_moved_to_the_origin(tmp_path):
    class Ends(Raw):
        def rebase(self, x: np.ndarray) -> np.ndarray:
            return x - x[-1]

    body = np.arange(50.0)[:, None, None].repeat(22, 1).repeat(3, 2).astype(np.float32)
    store = stored(body, captions=[["walks"]])
    write_clips(tmp_path / "out", store, cast(Any, Ends()), store.clips, 40)
    (file,) = (tmp_path / "out").glob("*.npz")
    with np.load(file) as arrays:
        assert arrays["joints"][-1].max() == 0
        assert arrays["joints"][0].min() == -39
        assert str(arrays["split"]) == "train"
