"""Requests for samples: files of prompts, lengths, videos, where motions are written; and the model in the package."""

import json
import re
import sys
from contextlib import nullcontext, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.motions import Page
from support.refusals import error_of, one_line_error

import flame_mdm
from evaluators.metrics.attributes import read_attributes
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.locating import find
from flame_mdm.commands.sample import GALLERY, SampleSettings, _distance, _gallery, _write_files
from flame_mdm.conditions.prompts import read_prompt
from flame_mdm.conditions.vocabulary import advice, check_known
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.safe_io import read_package_yaml, sha256
from flame_mdm.sampling import targets
from flame_mdm.sampling.output import default_folder
from flame_mdm.sampling.prompt_file import PromptFile

SENTENCES = read_package_yaml(ROOT / "tests" / "fixtures" / "sentences.yaml")
PROMPTS = ["a person walks", "a person jumps: 100%, twice", "人が歩く, waving"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_each_prompt_of_a_file_is_sampled_as_if_alone(here, trained, capsys):
    Path("p.txt").write_bytes(
        b"\xef\xbb\xbf" + "\r\n\r\n".join(f" {text} " for text in PROMPTS).encode()
    )
    assert main(["sample", str(trained), "prompts=p.txt", "seconds=[0.5,1,0.5]", "samples=2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    page = lines[-1].removeprefix("6 motions for 3 prompts, one folder per prompt: ")
    assert page == "samples/quickstart/p.html"
    assert all(
        json.dumps(text, ensure_ascii=True)[1:-1] in Path(page).read_text() for text in PROMPTS
    )
    assert "warning: '人が歩く, waving': not understood: 人が歩く" in "\n".join(lines)
    together = {read(path).text: path.parent for path in here.rglob("motion_000.npz")}
    assert set(together) == set(PROMPTS)
    text, file = PROMPTS[1], together[PROMPTS[1]] / "motion_001.npz"
    kept, before = set(here.rglob("*")), read(file)
    assert len(list(together[text].iterdir())) == 5
    assert main(["sample", str(trained), f"text={text}", "seconds=1", "samples=2"]) == 0
    np.testing.assert_allclose(read(file).joints, before.joints, atol=1e-4)  # in the same folder
    assert set(here.rglob("*")) == kept


@pytest.mark.parametrize(
    ("prompt", "parts", "expected"),
    [
        ("A person walks.", [("A person walks.", 2.0)], [("A person walks.", 2.0)]),
        (
            "walks, then waves",
            [("walks, then waves", None)],
            [("walks", None), ("waves", None)],
        ),
        (
            "walks @1 | waves, then sits",
            [("walks", 1.0), ("waves, then sits", None)],
            None,
        ),
    ],
)
def test_only_a_sentence_with_several_actions_is_split(prompt, parts, expected):
    facts = {"verbs": ["walks", "waves", "sits"]}
    read = read_prompt(prompt, parts, facts, splits=expected is not None, check_words=False)
    assert list(read.parts) == (expected or parts)
    assert list(read.captions) == [words for words, _ in expected or parts]


@pytest.mark.slow
def test_a_chosen_folder_gets_a_folder_per_prompt_without_files_of_an_earlier_request(
    here, trained
):
    Path("p.txt").write_text("a person walks\na person jumps\na person walks\n")
    words, videos = ["prompts=p.txt", "seconds=0.5", "samples=1", "out=mine"], bool(find_spec("av"))
    assert main(["sample", str(trained), *words, "trajectory=true", f"mp4={videos}".lower()]) == 0
    jumps, walks, page = sorted(Path("mine").iterdir())
    assert [jumps.name[:-7], walks.name[:-7], page.name] == [
        "a-person-jumps",
        "a-person-walks",
        "p.html",
    ]
    first, second = (read(path) for path in sorted(walks.glob("motion_*.npz")))
    assert np.abs(first.joints - second.joints).max() > 0.001
    assert [path.parent for path in Path("mine").rglob("trajectory.png")] == [walks]
    assert len(list(Path("mine").rglob("motions.mp4"))) == 2 * videos
    (walks / "motion_1_of_mine.npz").touch()
    assert main(["sample", str(trained), *words]) == 0
    numbers = [f"motion_{number}.npz" for number in ("000", "001", "1_of_mine")]
    assert sorted(path.name for path in walks.iterdir()) == [
        *numbers,
        "motions.gif",
        "motions.png",
        "player.html",
    ]


def test_a_bad_request_is_one_line_and_writes_nothing(here, trained, capsys, monkeypatch, subtests):
    monkeypatch.setitem(sys.modules, "av", None)
    for content, words, message in (
        (None, [], "p.txt: no such file"),
        (b" \n\t\r\n\n", [], "p.txt contains no prompts. Write one per line"),
        (b"PK\x03\x04\xff\xfe\x00", [], "p.txt: not a UTF-8 text file"),
        (b"a\n" * 2**20, [], "p.txt: the file is 2 MiB, but at most 1 MiB is allowed"),
        (
            b"walks",
            ["mp4=true"],
            'mp4=true: MP4 requires the av package. Run pip install "flame-mdm[video]"',
        ),
        (b"walks", ["text=jumps"], "text and prompts cannot be combined. Use only one of them"),
        (
            b"walks\njumps",
            ["seconds=[1,2,3]"],
            "seconds=[1, 2, 3]: the number of lengths is 3, but the number of prompts is 2",
        ),
        (
            b"walks | | sits\n\n" + b"a" * 3000,
            [],
            "p.txt: 2 of 2 prompts cannot be sampled. Correct the lines above",
        ),
        (b"\nwalks", ["seconds=30"], "p.txt: 1 of 1 prompts cannot be sampled"),
    ):
        with subtests.test(content=content, words=words, message=message):
            Path("p.txt").unlink(missing_ok=True)
            if content is not None:
                Path("p.txt").write_bytes(content)
            assert message in error_of(capsys, "sample", trained, "prompts=p.txt", *words)
            assert not Path("samples").exists()


@pytest.mark.slow
def test_refused_lines_of_a_file_are_named_at_the_end_and_the_others_are_written(
    here, trained, capsys, subtests
):
    lines = [
        "a person walks",
        "",
        "a" * 3000,
        "walks | | sits",
        "a person jumps",
        "un uomo cammina",
        "a person waves",
    ]
    Path("p.txt").write_text("\n".join(lines))
    words = ["prompts=p.txt", "seconds=[1,1,1,30,1,1.5]", "samples=1", "num_inference_steps=2"]
    assert main(["sample", str(trained), *words]) == 1
    printed = capsys.readouterr()
    assert (
        "2 motions for 2 prompts, one folder per prompt: samples/quickstart/p.html" in printed.out
    )
    *errors, total = printed.err.splitlines()[-5:]
    assert total == "error: p.txt: 4 of 6 prompts cannot be sampled. Correct the lines above"
    for line, number, message in zip(
        errors,
        (3, 4, 5, 6),
        (
            "the text has 3,000 characters",
            "part 2 is empty",
            "30 seconds (600 frames)",
            "only English prompts",
        ),
        strict=True,
    ):
        with subtests.test(number=number, message=message):
            assert line.startswith(f"p.txt, line {number}: ")
            assert message in line
    motions = [read(path) for path in sorted(here.rglob("motion_*.npz"))]
    assert {motion.text: len(motion.joints) for motion in motions} == {
        "a person walks": 20,
        "a person waves": 30,
    }


def test_each_prompt_has_a_length_of_its_own(trained, subtests):
    model = flame_mdm.load(trained)
    motions = flame_mdm.generate(model, PROMPTS[:2], seconds=[1, 1.5], samples=2)
    assert [(m.text, len(m.joints)) for m in motions] == [(PROMPTS[0], 20)] * 2 + [
        (PROMPTS[1], 30)
    ] * 2
    numpy: dict[str, Any] = {"seconds": np.float32(1.5)}
    np.testing.assert_allclose(
        motions[2].joints, flame_mdm.generate(model, PROMPTS[1], **numpy)[0].joints, atol=1e-4
    )
    for seconds, message in (
        (
            [1, 2],
            r"seconds=\[1, 2\]: the number of lengths is 2, but the number of prompts is 1\. Use one",
        ),
        ([], "lengths is 0, but the number of prompts is 1"),
        *(
            (value, "is not a valid length")
            for value in ([[1]], ["x"], [float("nan")], 10**400, "3")
        ),
    ):
        with subtests.test(message=message), one_line_error(message):
            flame_mdm.generate(model, PROMPTS[0], seconds=seconds)  # type: ignore[arg-type]


def folder(experiment: Any, text: str = "a person walks", **options: Any) -> str:
    model: Any = SimpleNamespace(config={"experiment": experiment})
    return default_folder(model, text, "f00d", options).as_posix()


def test_requests_for_different_motions_share_no_folder():
    texts = [
        "a person walks",
        "A person walks",
        "a Person walks",
        "a person-walks",
        "a person  walks",
    ]
    texts += [
        "a person_walks",
        "a per\u017fon walks",
        "A PERSON WALKS",
        "straße",
        "strasse",
        "a person walks.",
    ]
    texts += ["a person, walks", "🕺💃", "💃🕺", "人が歩く", "a" * 70, "a" * 71]
    options: list[dict[str, Any]] = [{"guidance_scale": scale} for scale in (-1, 1, 1.5)]
    options += [{"frames": [1, 2]}, {"frames": [12]}, {"sampler": "ddim"}, {"seed": 1}]
    names = [folder("a", text).casefold() for text in texts]  # as file systems that ignore case
    names += [folder("a", **changed) for changed in options]
    assert len(set(names)) == len(names)
    assert re.fullmatch(
        r"samples/humanml3d/mdm/a-person-walks-[0-9a-f]{6}", folder("humanml3d/mdm")
    )
    assert re.fullmatch(
        r"samples/a/(walks-){6}walk-[0-9a-f]{6}", folder("a", "walks " * 20, seed=1)
    )


def test_no_checkpoint_leads_out_of_the_folder(here, subtests):
    names = [
        "../../x",
        "/etc/x",
        "..",
        "a/../../../b",
        ".x",
        "a\0b",
        "~/x",
        "-/..",
        None,
        3,
        "",
        "\\..\\x",
        ". .",
    ]
    for name in names:
        with subtests.test(name=name):
            path = Path(
                folder(name, "../../../etc passwd\0", sampler="../../x", joints=["/a", ".."])
            )
            assert ".." not in path.parts
            assert "\0" not in str(path)
            assert path.resolve().is_relative_to(here / "samples")


@pytest.mark.slow
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.robustness)])
def test_the_model_understands_sentences_as_people_type_them(every):
    """A motion is right if it shows every attribute that its sentence states; a list holds what fits."""
    assert len(SENTENCES) == len({sentence["text"].lower() for sentence in SENTENCES}) == 300
    model, known = flame_mdm.load("quickstart"), {}
    assert all(value.dtype == torch.float32 for value in model.parameters())
    for sentence in SENTENCES[::every]:
        with suppress(UserError):
            check_known(sentence["text"], model.facts)
            known[sentence["text"]] = {
                key: value for key, value in sentence.items() if key != "text"
            }
    right, motions = 0, flame_mdm.generate(model, list(known), cleanup=True, num_inference_steps=10)
    for motion, stated in zip(motions, known.values(), strict=True):
        seen = read_attributes(motion.joints, motion.fps)
        right += all(
            seen.get(key) in (value if isinstance(value, list) else [value])
            for key, value in stated.items()
        )
    assert right / len(SENTENCES[::every]) >= 0.85


def test_the_shipped_file_is_documented_and_its_name_comes_after_paths(here, capsys):
    assert sha256(find("quickstart")) in (ROOT / "docs" / "checkpoints.md").read_text()
    assert find("quickstart").stat().st_size < 4.6e6
    assert "license: mit" in find("quickstart").with_suffix(".md").read_text()
    assert "Did you mean quickstart?" in error_of(
        capsys, "sample", "quikstart", "text=a person walks"
    )
    (here / "quickstart").mkdir()
    (here / "quickstart" / "mine.safetensors").touch()
    assert find("quickstart").name == "mine.safetensors"


@pytest.mark.parametrize("word", ["kickz\\1", "kickz\\n", ""])
def test_any_word_of_a_model_may_be_suggested(word):
    facts = {"vocabulary": [word, "", "walks"], "captions": []}
    (line,) = advice("a person kickzx", facts)
    suggestion = f" Did you mean 'a person {word}'?" if word else ""
    assert line == f"never seen in training: kickzx.{suggestion}"


def test_distances_from_targets_are_printed_in_centimeters_over_all_motions(monkeypatch):
    distances = iter([[0.01, 0.02], [0.123]])
    monkeypatch.setattr(targets, "errors", lambda *_: np.array(next(distances)))
    line = _distance(cast(Any, None), cast(Any, [None, None]))
    assert line == "distance from the targets: mean 5.1 cm, max 12.3 cm"


def test_refused_lines_keep_their_numbers_and_the_others_their_lengths(tmp_path):
    path = tmp_path / "prompts.txt"
    lines = [
        "\ufeffwalks",
        "",
        "  waves @0",
        "sits | ",
        "jumps  ",
        "x" * 2001,
        "y" * 2000,
        "bows @2",
    ]
    path.write_text("\r\n".join(lines), encoding="utf-8", newline="")
    file = PromptFile.read(str(path))
    assert list(file.lines) == [1, 3, 4, 5, 6, 7, 8]
    assert sorted(file.refused) == [3, 4, 6]
    assert list(file.accepted.values()) == ["walks", "jumps", "y" * 2000, "bows @2"]
    assert file.lengths("seconds", [1, 3, 4, 5, 6, 7, 8]) == [1, 5, 7, 8]
    assert file.lengths("seconds", 2.5) == 2.5
    with pytest.raises(UserError) as error:
        file.lengths("frames", [1, 2])
    assert str(error.value) == (
        "frames=[1, 2]: the number of lengths is 2, but the number of prompts is 7. "
        "Use one length, or one per prompt"
    )
    file.refuse({1: UserError("first\nsecond"), 3: UserError("last")})
    assert sorted(file.refused) == [3, 4, 5, 6, 8]
    assert list(file.accepted) == [1, 7]
    assert file.lengths("frames", range(10, 17)) == [10, 15]
    shown = [line.removeprefix(f"{path}, ") for line in file.report()]
    assert [line.split(":")[0] for line in shown] == [f"line {n}" for n in (3, 4, 5, 6, 8)]
    assert (shown[2], shown[4]) == ("line 5: first", "line 8: last")
    for content in ("", " \n\t\n", "walks\0"):
        path.write_text(content)
        with pytest.raises(UserError, match=r"contains no prompts\. Write one per line"):
            PromptFile.read(str(path))


def test_files_of_several_motions_are_numbered_from_two_and_have_the_chosen_rate(tmp_path):
    motions = [
        Motion(np.zeros((11, 22, 3), np.float32), 10.0, text=name) for name in ("a", "b", "c")
    ]
    settings = SampleSettings(ckpt="x", text="a", resample=20)
    _write_files(settings, tmp_path / "walk.npz", motions, None, None, {"seed": 3})
    names = {"walk.npz": "a", "walk_2.npz": "b", "walk_3.npz": "c"}
    assert {path.name for path in tmp_path.iterdir()} == set(names)
    for name, text in names.items():
        with np.load(tmp_path / name) as arrays:
            assert (str(arrays["text"]), float(arrays["fps"]), int(arrays["seed"])) == (text, 20, 3)
            assert len(arrays["joints"]) == 21


def test_the_page_of_a_prompt_file_has_the_first_motion_of_each_prompt_up_to_200(
    tmp_path, monkeypatch
):
    assert GALLERY == 200
    monkeypatch.setattr("flame_mdm.commands.sample.GALLERY", 3)
    motion = Motion(np.random.default_rng(0).random((5, 22, 3)).astype(np.float32), 10.0)
    folders = {
        tmp_path / f"{number}-walks": [replace(motion, text=f"{number} {k}") for k in range(2)]
        for number in range(4)
    }
    line = _gallery(cast(Any, SimpleNamespace(path="some/mine.txt")), folders, None)
    page = tmp_path / "mine.html"
    assert line == f"8 motions for 4 prompts, one folder per prompt: {page}"
    shown = [(entry["id"], entry["caption"]) for entry in Page(page).motions]
    assert shown == [(f"{number}-walks", f"{number} 0") for number in range(3)]
    assert Page(page).texts["h1"] == "4 prompts"


@pytest.mark.parametrize(("options", "message"), [
    ({"scorer": "claims"}, "scorer=claims chooses among several motions"),
    ({"scorer": "claims", "candidates": 2}, None), ({"candidates": 2}, None),
    ({"scorer": "claims", "candidates": 2, "text": None, "action": "walk"}, "Add text="),
])  # fmt: skip
def test_a_scorer_needs_several_candidates_for_a_text(options, message):
    settings = SampleSettings(ckpt="x", **({"text": "walks"} | options))
    with pytest.raises(UserError, match=message) if message else nullcontext():
        settings.request_for(None)
