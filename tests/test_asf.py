"""ASF/AMC files: joints in closed form, damaged files. CMU's own files are in test_cmu.py."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats import asf

SKELETON = """# two bones: an arm along x that turns about its own axes, and a hand without freedoms
:units
  length 0.45
  angle deg
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     name arm
     direction 1 0 0
     length 2
     axis 0 0 90 XYZ
     dof rx rz
     limits (-160.0 20.0)
            (-70.0 70.0)
  end
  begin
     name hand
     direction 0 1 0
     length 3
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root arm
    arm hand
  end
"""
MOTION = """#!OML:ASF x.ASF
:FULLY-SPECIFIED
:DEGREES
1
root 10 20 30 0 0 0
arm 0 0
2
root 10 20 30 0 0 90
arm 90 0
3
root 0 0 0 10 20 30
arm 40 50
"""


@pytest.fixture
def files(tmp_path):
    (tmp_path / "07.asf").write_text(SKELETON)
    (tmp_path / "07_01.amc").write_text(MOTION)
    return tmp_path


def test_joints_in_closed_form_and_missing_skeletons_and_rates(files):
    motion = asf.read(files / "07_01.amc", 120)
    assert (motion.joints, motion.parents) == (("root", "arm", "hand", "hand.end"), (-1, 0, 1, 2))
    positions = motion.positions()
    assert positions[0].tolist() == [[10, 20, 30], [10, 20, 30], [12, 20, 30], [12, 23, 30]]
    # the arm's x axis is the world's y: by 90 degrees about it, x becomes -z; then the root turns x to y
    np.testing.assert_allclose(
        positions[1], [[10, 20, 30], [10, 20, 30], [10, 20, 28], [7, 20, 28]], atol=1e-12
    )
    turns = (("ZYX", [30, 20, 10]), ("Z", 90), ("ZX", [50, 40]))
    root, axes, turned = (
        Rotation.from_euler(order, angles, degrees=True).as_matrix() for order, angles in turns
    )
    arm = root @ axes @ turned @ axes.T
    np.testing.assert_allclose(positions[2, 2:], [arm @ [2, 0, 0], arm @ [2, 3, 0]], atol=1e-12)
    (files / "07.asf").rename(files / "someone.asf")  # the only skeleton of the folder
    np.testing.assert_array_equal(asf.read(files / "07_01.amc", 120).frames, motion.frames)
    with pytest.raises(
        UserError,
        match=r"AMC files contain no frame rate\. Set fps=120, or add `fps: 120` to skeleton",
    ):
        asf.read(files / "07_01.amc", None)
    (files / "someone.asf").unlink()
    with pytest.raises(UserError, match=r"no skeleton 07\.asf next to it"):
        asf.read(files / "07_01.amc", 120)


def test_rotations_are_applied_in_the_order_of_the_axes_however_the_freedoms_are_listed(files):
    expected = asf.read(files / "07_01.amc", 120).positions()
    (files / "07.asf").write_text(SKELETON.replace("dof rx rz", "dof rz rx"))
    (files / "07_01.amc").write_text(
        MOTION.replace("arm 90 0", "arm 0 90").replace("arm 40 50", "arm 50 40")
    )
    np.testing.assert_allclose(asf.read(files / "07_01.amc", 120).positions(), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (":DEGREES", ":RADIANS", "07_01.amc, line 3: angles in radians are not supported"),
        ("angle deg", "angle rad", "07.asf, line 4: angles in radians are not supported"),
        ("arm 40 50", "arm 40", r"07_01.amc, line 12: expected 2 finite number\(s\), found 40"),
        ("arm 40 50", "leg 40 50", "line 12: leg is not a moving bone"),
        ("arm 40 50\n", "", "line 11: frame 3 ends without arm"),
        (MOTION, "", "line 1: not an AMC file"),
        (
            MOTION,
            "version https://git-lfs.github.com/spec/v1\n",
            "a Git LFS pointer, not the file",
        ),
        (
            "dof rx rz",
            "dof rx l",
            "07.asf, line 19: degrees of freedom must be among rx, ry and rz",
        ),
        ("axis 0 0 90 XYZ", "axis 0 0 90 XXZ", "line 19: expected an axis order such as XYZ"),
        ("    arm hand", "    arm foot", "line 29: bone foot is unknown"),
        ("   position 0 0 0", "   position 0 1 0", "line 8: a root whose position is not 0 0 0"),
        ("     length 2\n", "", "line 18: a bone has no length"),
        (SKELETON, "HIERARCHY\n", "07.asf, line 1: not an ASF file"),
    ],
)
def test_damaged_files_are_named_with_their_line(files, old, new, message):
    for name in ("07.asf", "07_01.amc"):
        (files / name).write_text((files / name).read_text().replace(old, new))
    with pytest.raises(UserError, match=message):
        asf.read(files / "07_01.amc", 120)


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ"])
def test_angles_of_an_axis_line_are_about_x_y_and_z_and_are_applied_in_the_order_of_its_letters(
    files, order: str
):
    angles = {"X": 20, "Y": 30, "Z": 40}
    text = SKELETON.replace("axis 0 0 90 XYZ", f"axis 20 30 40 {order}")
    (files / "07.asf").write_text(text)
    expected = Rotation.identity()
    for letter in order:
        expected = Rotation.from_euler(letter.lower(), angles[letter], degrees=True) * expected
    bones, _ = asf.read_skeleton(files / "07.asf")
    np.testing.assert_allclose(bones["arm"].axes.as_matrix(), expected.as_matrix(), atol=1e-12)


ORDER, AXIS = "   order RZ RX TZ TX RY TY\n", "   axis ZXY\n"


@pytest.mark.parametrize("lines", [ORDER + AXIS, AXIS + ORDER])
def test_the_root_has_its_own_order_of_numbers_and_of_rotations(files, lines: str):
    start, end = SKELETON.index("   order"), SKELETON.index("   position")
    (files / "07.asf").write_text(SKELETON[:start] + lines + SKELETON[end:])
    text = MOTION.replace("10 20 30 0 0 0", "0 0 30 10 0 20")
    text = text.replace("10 20 30 0 0 90", "90 0 30 10 0 20")
    (files / "07_01.amc").write_text(text.replace("0 0 0 10 20 30", "30 10 3 1 20 2"))
    motion = asf.read(files / "07_01.amc", 120)
    roots = [[10, 20, 30], [10, 20, 30], [1, 2, 3]]
    np.testing.assert_allclose(motion.positions()[:, 0], roots, atol=1e-12)
    # first about z, then about x, then about y
    turned = Rotation.from_euler("zxy", [30, 10, 20], degrees=True).as_matrix()
    np.testing.assert_allclose(motion.rotations()[2, 0], turned, atol=1e-12)


def test_the_skeleton_of_a_motion_comes_before_that_of_its_subject_and_of_its_folder(tmp_path):
    names = ["07_01.asf", "07.asf", "someone.asf"]
    for name in names:
        (tmp_path / name).touch()
    for name in names:
        assert asf.skeleton_of(tmp_path / "07_01.amc").name == name
        (tmp_path / name).unlink()
