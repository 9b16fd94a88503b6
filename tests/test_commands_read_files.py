"""Files as other programs write them, in every command that reads motions: `convert`, `inspect`, `prepare`, `edit`."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from support.fixtures import SHARED
from support.others import COLLECTED, walk

from flame_mdm.__main__ import main
from flame_mdm.formats.layouts import head_height
from flame_mdm.formats.readers import read

FILES = SHARED / "data" / "files-of-others"
STANDS, LIES = "stands", "lies"


@dataclass
class Row:
    """A file and the messages of all commands about it.

    Attributes:
        result: whether the body of the motion stands or lies; "" if the file is refused.
        says: regular expression of the message that every command prints about the file.
        keys: keys of the command; `prepare` finds them in skeleton.yaml.
        refused_by_prepare: what `prepare` says if it alone refuses the file.
    """

    result: str
    says: str = ""
    keys: dict[str, str] = field(default_factory=dict)
    refused_by_prepare: str = ""


LYING = "the body is lying down"
ROWS = {
    "f01_stageii.npz": [Row(STANDS)],
    "f02_y_up.npz": [
        Row(LIES, f"{LYING}.*up=y", refused_by_prepare=LYING),
        Row(STANDS, keys={"up": "y"}),
    ],
    "f03_z_up.bvh": [
        Row(LIES, f"{LYING}.*up=z", refused_by_prepare=LYING),
        Row(STANDS, keys={"up": "z"}),
    ],
    "f03_swapped_sides.bvh": [Row("", "the toes point backwards. Swap left and right")],
    "f04_rotmat_216.npz": [Row("", r"216.*rotation matrices\. Convert them to axis-angle")],
    "f05_json_z_up.json": [Row(STANDS), Row(STANDS, keys={"up": "z"})],
    "f06_tpose_first.bvh": [Row(STANDS, "the first frame is a rest pose and is left out")],
    "f09_names_with_spaces.bvh": [Row(STANDS)],
    "f09_prefix_underscore.bvh": [Row(STANDS)],
    "f09_smpl_capital.bvh": [Row(STANDS)],
    "f12_thirty_joints.npz": [
        Row(
            "",
            "30 joints like SOMA, but not in the same order.*Add the names of all joints.*skeleton.yaml",
        )
    ],
    "f12_body_only_66.npz": [Row(STANDS)],
    "f12_rate_of_one_element.npz": [Row(STANDS)],
    "f13_shorter_person.npz": [
        Row(STANDS, r"the feet are \d cm below the floor.*the body in the file is smaller")
    ],
    "f14_two_people.bvh": [Row(STANDS, "the file contains 2 people")],
    "f15_half.npz": [Row(STANDS)],
    "f18_git_lfs_pointer.bvh": [Row("", "a Git LFS pointer.*git lfs pull")],
    "f20_more_frames_than_stated.bvh": [Row("", r"the file contains \d+ frames, but declares \d+")],
}
CASES = [(name, row) for name, rows in ROWS.items() for row in rows]


def check_convert(path: Path, row: Row, expected: float, out: Path, capsys) -> None:
    code = main(
        ["convert", str(path), str(out), *(f"{key}={value}" for key, value in row.keys.items())]
    )
    printed = "".join(capsys.readouterr())
    assert re.search(row.says, printed, re.DOTALL), printed
    assert (code == 0) == out.exists() == bool(row.result)
    if row.result:
        height = head_height(np.load(out))
        assert (
            (height < 0.5) if row.result == LIES else (height == pytest.approx(expected, abs=0.02))
        )


@pytest.mark.parametrize(
    ("name", "row"), CASES, ids=[f"{name} {row.keys or ''}" for name, row in CASES]
)
def test_every_command_reads_or_refuses_a_file_alike(name: str, row: Row, tmp_path: Path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    COLLECTED[name](folder / name)
    check_convert(folder / name, row, head_height(walk().joints), tmp_path / "a.npy", capsys)
    if (FILES / name).exists():
        check_convert(FILES / name, row, 1.555, tmp_path / "b.npy", capsys)

    keys = [f"{key}={value}" for key, value in row.keys.items()]
    code = main(["inspect", str(folder / name), str(tmp_path / "page.html"), *keys])
    printed = "".join(capsys.readouterr())
    assert re.search(row.says, printed, re.DOTALL), printed
    assert code in ((0, 3) if row.result else (1,))

    if row.keys:
        (folder / "skeleton.yaml").write_text(
            "".join(f"{key}: {value}\n" for key, value in row.keys.items())
        )
    words = [f"source={folder}", f"data_root={tmp_path}", "check=true", "data.source.workers=1"]
    code = main(["prepare", "folder", *words])
    printed = "".join(capsys.readouterr())
    assert re.search(row.refused_by_prepare or row.says, printed, re.DOTALL), printed
    assert code == (0 if row.result and not row.refused_by_prepare else 1)


EDITED = ("f03_z_up.bvh", "f03_swapped_sides.bvh", "f12_thirty_joints.npz")


def test_edit_says_the_same(trained: Path, tmp_path: Path, capsys, subtests):
    for name in EDITED:
        with subtests.test(name=name):
            COLLECTED[name](tmp_path / name)
            words = [
                "region=in_between",
                "unconditioned=true",
                "samples=1",
                f"out={tmp_path / 'out'}",
            ]
            code = main(["edit", str(trained), str(tmp_path / name), *words])
            printed = "".join(capsys.readouterr())
            assert re.search(ROWS[name][0].says, printed, re.DOTALL), printed
            assert code == (0 if ROWS[name][0].result else 1)


def test_a_character_that_is_compressed_is_refused(tmp_path: Path, capsys, subtests):
    COLLECTED["f09_smpl_capital.bvh"](tmp_path / "a.bvh")
    COLLECTED["f11_meshopt.glb"](tmp_path / "b.glb")
    for character in [tmp_path / "b.glb", *([FILES / "f11_meshopt.glb"] if FILES.exists() else [])]:
        with subtests.test(character=character):
            assert (
                main(
                    [
                        "convert",
                        str(tmp_path / "a.bvh"),
                        str(tmp_path / "o.glb"),
                        f"character={character}",
                    ]
                )
                == 1
            )
            assert "it requires EXT_meshopt_compression" in capsys.readouterr().err


# Words and exit code of the check, then the motions that `convert` writes and its exit code.
FOLDERS = {
    "f02_folder": ("2 clips can be prepared", 0, ["a", "b"], 0),
    "f07_check_rc": (
        r"bad\.bvh, line 164: .* 1 of 2 motions in .* cannot be prepared",
        1,
        ["good"],
        1,
    ),
    "f07_one_frame": (
        r"rest\.bvh: only 1 frames at 20 .* 1 of 2 motions in .* cannot be prepared",
        1,
        ["rest", "walk"],
        0,
    ),
    "f08_batch": (r"b\.bvh, line 4: .* 1 of 3 motions in .* cannot be prepared", 1, ["a", "c"], 1),
    "f08_macos": ("1 clips can be prepared", 0, ["a"], 0),
}


@pytest.mark.skipif(
    not FILES.exists(), reason="the files of other programs are outside of the repository"
)
@pytest.mark.parametrize("name", FOLDERS)
def test_folders_of_the_collection(name: str, tmp_path: Path, capsys):
    says, code, converted, converts = FOLDERS[name]
    words = [f"source={FILES / name}", f"data_root={tmp_path}", "data.source.workers=1"]
    assert main(["prepare", "folder", *words, "check=true"]) == code
    printed = "".join(capsys.readouterr())
    assert re.search(says, printed, re.DOTALL), printed
    assert main(["convert", str(FILES / name), str(tmp_path / "out"), "format=npy"]) == converts
    assert sorted(path.stem for path in (tmp_path / "out").iterdir()) == converted
    assert main(["inspect", str(FILES / name), str(tmp_path / "page.html")]) in (
        (1,) if converts else (0, 3)
    )
    assert (tmp_path / "page.html").exists()
    if name == "f02_folder":
        assert head_height(np.load(tmp_path / "out" / "a.npy")) == pytest.approx(1.57, abs=0.02)
    if name == "f07_one_frame":
        assert main(["prepare", "folder", *words]) == 1, "the same verdict as the check"


WITHOUT_REST = "f06_reference_without.bvh"
# File -> the file with the same joints.
SAME = {
    "f01_stageii.npz": "f01_reference_without_objects.npz",
    "f12_body_only_66.npz": "f01_reference_without_objects.npz",
}


@pytest.mark.skipif(
    not FILES.exists(), reason="the files of other programs are outside of the repository"
)
@pytest.mark.parametrize("name", SAME)
def test_files_of_the_collection_have_the_joints_of_their_reference(name: str):
    motion, reference = read(FILES / name), read(FILES / SAME[name])
    np.testing.assert_allclose(motion.joints, reference.joints, atol=1e-4)
    assert motion.fps == reference.fps


@pytest.mark.skipif(
    not FILES.exists(), reason="the files of other programs are outside of the repository"
)
def test_a_file_of_the_collection_has_the_motion_after_its_rest_pose():
    motion, reference = read(FILES / "f06_tpose_first.bvh"), read(FILES / WITHOUT_REST)
    assert len(motion.joints) == len(reference.joints) == 30
    times = 30 / 31 * np.arange(1, 30)  # the motion lasts 31 frames with the rest pose, else 30
    before, share = times.astype(int), (times % 1)[:, None, None]
    expected = (1 - share) * reference.joints[before] + share * reference.joints[before + 1]
    np.testing.assert_allclose(motion.joints[:-1], expected, atol=0.005)


@pytest.mark.skipif(
    not FILES.exists(), reason="the files of other programs are outside of the repository"
)
def test_every_file_of_the_collection_is_tested():
    names = {path.name for path in FILES.iterdir()} - {"README.md"}
    assert names == {*ROWS, *FOLDERS, *SAME.values(), WITHOUT_REST, "f11_meshopt.glb"}
    assert len(names) == 26
