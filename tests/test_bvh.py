"""BVH files: positions and rotations in closed form, round trips, resampling, damaged files."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats import bvh

ARM = """HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Arm
  {
    OFFSET 5 0 0
    CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT Hand { OFFSET 0 -2 0 End Site { OFFSET 0 0 1 } }
  }
  JOINT Slider { OFFSET 0 7 9 CHANNELS 1 Yposition }
}
MOTION
Frames:\t3
Frame Time:\t0.0333333
0 0 0 0 0 0 0 0 0 7
0 90 -3 90 0 0 0 0 0 8
4 5 6 10 20 30 40 50 60 9.5
"""


def matrix(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis.lower(), degrees, degrees=True).as_matrix()


@pytest.fixture
def parse(tmp_path) -> Callable[[str | bytes], bvh.Bvh]:
    path = tmp_path / "arm.bvh"

    def parse(content: str | bytes) -> bvh.Bvh:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return bvh.read(path)

    return parse


def tree(seed: int, frames: int = 7) -> bvh.Bvh:
    """A random skeleton whose joints do not come in depth-first order, with random channels."""
    rng = np.random.default_rng(seed)
    parents = (-1, 0, 0, 1, 2, 1, 3)
    channels = [tuple(rng.permutation(bvh.CHANNELS)) for _ in range(3)]
    channels += [tuple(rng.permutation(bvh.CHANNELS[3:])) for _ in range(3)] + [()]
    frames_ = rng.normal(0, 60, (frames, sum(map(len, channels))))
    return bvh.Bvh(
        (*(f"joint{k}" for k in range(7)), "joint4.end", "joint5.end", "joint6.end"), (*parents, 4, 5, 6),
        rng.normal(size=(10, 3)), (*channels, (), (), ()), frames_, 29.97,
    )  # fmt: skip


def test_the_hierarchy_and_its_motion_are_read(parse):
    motion = parse(ARM)
    assert (motion.joints, motion.parents) == (
        ("Hips", "Arm", "Hand", "Hand.end", "Slider"),
        (-1, 0, 1, 2, 0),
    )
    assert motion.channels[1:] == (("Yrotation", "Xrotation", "Zrotation"), (), (), ("Yposition",))
    assert motion.offsets.tolist() == [[1, 2, 3], [5, 0, 0], [0, -2, 0], [0, 0, 1], [0, 7, 9]]
    assert (motion.frames.shape, motion.frames.dtype, motion.fps) == ((3, 10), np.float64, 30)
    other = parse("\ufeff" + ARM.replace("\n", "\r\n"))
    np.testing.assert_array_equal(other.frames, motion.frames)
    assert other.joints == motion.joints

    # position channels replace the offset, and rotations follow the order of the channels
    positions = motion.positions()
    assert positions[0].tolist() == [[0, 0, 0], [5, 0, 0], [5, -2, 0], [5, -2, 1], [0, 7, 9]]
    # turned by 90 degrees about z: x goes to y, y to -x
    np.testing.assert_allclose(
        positions[1], [[0, 90, -3], [0, 95, -3], [2, 95, -3], [2, 95, -2], [-8, 90, 6]], atol=1e-12
    )

    rotations = motion.rotations()[2]
    hips = matrix("Z", 10) @ matrix("X", 20) @ matrix("Y", 30)
    shoulder = matrix("Y", 40) @ matrix("X", 50) @ matrix("Z", 60)
    np.testing.assert_allclose(
        rotations, [hips, shoulder, np.eye(3), np.eye(3), np.eye(3)], atol=1e-12
    )
    positions = positions[2]
    np.testing.assert_allclose(positions[1], np.array([4, 5, 6]) + hips @ [5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        positions[2], positions[1] + hips @ shoulder @ [0, -2, 0], atol=1e-12
    )
    np.testing.assert_allclose(positions[3], positions[2] + hips @ shoulder @ [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(positions[4], np.array([4, 5, 6]) + hips @ [0, 9.5, 9], atol=1e-12)


def test_names_of_channels_may_be_written_in_any_case(parse):
    text = ARM.replace("Xposition", "XPOSITION").replace("Yrotation", "yrotation")
    motion, other = parse(ARM), parse(text)
    assert other.channels == motion.channels
    np.testing.assert_array_equal(other.positions(), motion.positions())


def test_fps_is_the_one_the_rounded_frame_time_stands_for(parse, subtests):
    for time, fps in (
        *(
            ("0.0333333", 30),
            ("0.0333", 30),
            ("0.008333", 120),
            ("8.33333E-03", 120),
            ("0.08", 12.5),
        ),
        *(("0.016666", 60), ("0.01668335", 1 / 0.01668335), (".25", 4), ("2", 0.5)),
    ):
        with subtests.test(time=time, fps=fps):
            assert parse(ARM.replace("0.0333333", time)).fps == fps, time


def test_what_is_written_reads_back(tmp_path):
    motion = tree(0)
    bvh.write(motion, tmp_path / "tree.bvh")
    back = bvh.read(tmp_path / "tree.bvh")
    assert [path.name for path in tmp_path.iterdir()] == ["tree.bvh"]
    assert back.fps == pytest.approx(motion.fps, rel=1e-15)
    order = [back.joints.index(name) for name in motion.joints]
    np.testing.assert_array_equal(back.positions()[:, order], motion.positions())
    bvh.write(back, tmp_path / "again.bvh")
    assert (tmp_path / "again.bvh").read_bytes() == (tmp_path / "tree.bvh").read_bytes()


def test_cubic_resampling_keeps_accelerated_translations_exact():
    motion = replace(tree(0, 13), fps=30.0)
    joint = next(number for number, names in enumerate(motion.channels) if "Xposition" in names)
    column = motion.columns()[joint].start + motion.channels[joint].index("Xposition")
    times = np.arange(13) / 30
    motion.frames[:, column] = 3 * times**3 - times**2 + 1
    _, moved = motion.resample(50, cubic=True)
    times = np.arange(len(moved)) / 50
    assert len(moved) == 21
    np.testing.assert_allclose(moved[:, joint, 0], 3 * times**3 - times**2 + 1, atol=1e-9)


def test_rotations_may_be_listed_before_positions(parse):
    motion = parse(ARM)
    names, columns = motion.channels[0], motion.columns()[0]
    assert len(names) == 6
    order = [*range(3, 6), *range(3)]
    swapped = tuple(names[k] for k in order)
    frames = motion.frames.copy()
    frames[:, columns] = frames[:, columns][:, order]
    other = replace(motion, channels=(swapped, *motion.channels[1:]), frames=frames)
    np.testing.assert_array_equal(other.rotations(), motion.rotations())
    np.testing.assert_array_equal(other.positions(), motion.positions())


def test_resampling_turns_at_a_constant_rate_and_keeps_bones_and_the_last_frame(parse, subtests):
    for frames, expected in ((1, 1), (2, 1), (3, 2), (4, 3), (7, 5), (128, 85), (130, 87)):
        with subtests.test(frames=frames):
            motion = replace(tree(0, frames), fps=30.0)
            rotations, translations = motion.resample(20)
            assert len(rotations) == len(translations) == expected
            shared = slice(0, len(rotations[::2]))  # times 0, 0.1, 0.2, ... are frames of both
            np.testing.assert_allclose(rotations[::2], motion.rotations()[::3][shared], atol=1e-12)
            np.testing.assert_allclose(
                translations[::2], motion.translations()[::3][shared], atol=1e-12
            )

    frames = "0 0 0 170 0 0 0 0 0 7\n3 6 9 -170 0 0 0 90 0 7\n"
    motion = parse(ARM[: ARM.index("0 0 0 0 0 0")].replace("Frames:\t3", "Frames:\t2") + frames)
    rotations, translations = motion.resample(120)
    expected = Rotation.from_euler(
        "z", [[170], [175], [180], [185], [190]], degrees=True
    ).as_matrix()
    np.testing.assert_allclose(rotations[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(rotations[1, 1], matrix("X", 22.5), atol=1e-12)
    np.testing.assert_allclose(
        translations[:, 0], [[3 * k, 6 * k, 9 * k] for k in (0, 0.25, 0.5, 0.75, 1)], atol=1e-12
    )
    positions, _ = bvh.forward_kinematics(motion.parents, rotations, translations)
    lengths = np.linalg.norm(positions[:, [1, 2]] - positions[:, [0, 1]], axis=-1)
    np.testing.assert_allclose(lengths, np.tile([5, 2], (5, 1)), rtol=1e-14)


def test_damaged_files_are_named_with_the_line(parse, subtests):
    for content, line, reason in (
        ("\0\1", 1, "not a BVH file"),
        (b"HIERARCHY\nROOT \xff", 2, "not UTF-8"),
        (ARM[:60], 5, "ends inside the hierarchy"),
        (ARM.replace("OFFSET 5 0 0", "OFFSET 5 nan 0"), 8, "found 5 nan 0"),
        (ARM.replace("    OFFSET 5 0 0\n", ""), 10, "has no OFFSET"),
        (
            ARM.replace("Yrotation Xrotation Zrotation", "Yrotation Yrotation Zrotation"),
            9,
            "channels",
        ),
        (
            ARM.replace("Yrotation Xrotation Zrotation", "Yrotation Wrotation Zrotation"),
            9,
            "channels",
        ),
        (ARM.replace("  JOINT Arm\n  {", "  JOINT Arm\n"), 8, "expected {"),
        (ARM.replace("ROOT", "LIMB"), 2, "unexpected LIMB"),
        (ARM.replace("9.5\n", "9.5\n1 2\n"), 20, r"expected 10 finite number\(s\), found 1 2"),
        (ARM.replace("\n}\nMOTION", "\nMOTION"), 13, "after the hierarchy"),
        (ARM.replace("MOTION", "MOTION 3"), 14, "as the last word on its line"),
        (ARM.replace("Frames:\t3", "Frames: many"), 15, "expected Frames:"),
        (ARM.replace("0.0333333", "0"), 16, "frame time"),
        (ARM.replace("0.0333333", "fast"), 16, "expected Frame Time:"),
        (ARM.replace("Frames:\t3", "Frames:\t4"), 19, "contains 3 frames, but declares 4"),
        (ARM.replace("Frames:\t3", "Frames:\t2"), 19, "contains 3 frames, but declares 2"),
        (
            ARM[: ARM.index("0 0 0 0")].replace("Frames:\t3", "Frames:\t0"),
            16,
            "contains 0 frames, but declares 0",
        ),
        (ARM.replace("50 60 9.5", "50 60 oops"), 19, "expected 10 finite"),
        (ARM.replace("0 90 -3 90", "0 90 inf 90"), 18, "expected 10 finite"),
    ):
        with (
            subtests.test(content=content, line=line, reason=reason),
            pytest.raises(UserError, match=rf"arm\.bvh, line {line}: .*{reason}.*\Z"),
        ):
            parse(content)
    whole = ARM.rstrip("\n")
    for end in range(len(whole) - 3):  # what follows could be the shorter number that was meant
        with pytest.raises(UserError, match=r"arm\.bvh, line \d+: "):
            parse(whole[:end])


@pytest.mark.parametrize(
    ("seconds", "fps"),
    [
        ("0.0333333", 30), ("0.033333", 30), ("0.016667", 60), ("0.0166667", 60), ("0.041667", 24),
        ("0.008333", 120), ("0.00833333", 120), ("0.04", 25), ("0.0333667", 29.97), ("0.05", 20),
    ],
)  # fmt: skip
def test_rounded_frame_times_are_whole_rates(seconds: str, fps: float, parse):
    assert parse(ARM.replace("0.0333333", seconds)).fps == pytest.approx(fps, abs=1e-4)
    assert (parse(ARM.replace("0.0333333", seconds)).fps == fps) == (fps != 29.97)
