"""Bodies: a sound mesh, bound to clips and skinned."""

import math
import sys
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from support.motions import degrees, frames_array, posed, sway

from flame_mdm.errors import UserError
from flame_mdm.formats import body as body_module
from flame_mdm.formats.body import fit_body, proportions
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.people import (
    HEADS,
    SHAPE,
    _clothes,
    _joints,
    _owner,
    bake,
    load_body,
    shape_of,
    with_helpers,
)
from flame_mdm.formats.poses import _smooth, solve
from flame_mdm.formats.posture import _flat_foot, _toes, complete, world_rotations
from flame_mdm.representations.skeleton import JOINT, KIT21, SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.visualize import player_page, render
from flame_mdm.visualize.body import ANCHORS, MATERIALS, largest_weights, mannequin, sides


def test_the_mesh_is_one_closed_symmetric_surface_in_its_stored_pose():
    points, triangles = mannequin().points, mannequin().triangles
    assert 1000 <= len(points) <= 3000
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    distinct, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert len(points) - len(distinct) + len(triangles) == 2  # Euler: like a sphere
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert 0.05 < (a * np.cross(b, c)).sum() / 6 < 0.09  # cubic meters; a person of 1.78 m has 0.07
    assert 1.7 < np.ptp(points[:, 1]) < 1.85
    assert {tuple(p) for p in points.round(5).tolist()} == {
        tuple(p) for p in (points * [-1, 1, 1]).round(5).tolist()
    }
    np.testing.assert_allclose(mannequin().weights.sum(1), 1)
    assert ((mannequin().weights > 0).sum(1) <= 4).all()
    left = mannequin().weights @ np.array(sides(SMPL22), float)[list(ANCHORS)]
    assert (left[points[:, 0] > 0.2] > 0.5).all()
    assert (left[points[:, 0] < -0.2] < -0.5).all()
    # the stored pose gives the stored mesh
    turns = {"shoulder": (0, 0, -46), "elbow": (0, -14, 0), "hip": (0, 0, 4), "ankle": (0, 0, -4)}
    both = {f"left_{name}": turn for name, turn in turns.items()}
    both |= {f"right_{name}": (x, -y, -z) for name, (x, y, z) in turns.items()}
    points, _ = fit_body(posed(1, 1.0, **both)).skinned(0)
    points -= [0, 0.955 + mannequin().sole, 0]
    np.testing.assert_allclose(points, mannequin().points, atol=4e-3)  # a little twist


def test_joints_of_the_body_are_those_of_the_motion_and_soles_are_on_the_floor(subtests):
    turns: Any = {"left_hip": (-50, 10, 0), "left_knee": (70, 0, 0), "right_shoulder": (0, 30, 60)}
    motion = posed(scale=0.93, spine2=(15, 0, 9), **turns)
    drawn = fit_body(motion)
    np.testing.assert_allclose(
        drawn.starts[0, :22] - [0, drawn.lift, 0], motion.joints[0], atol=1e-6
    )
    points, normals = drawn.skinned(0)
    assert points[:, 1].min() == pytest.approx(0, abs=0.004)  # the right foot stands
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    solved = Motion(motion.joints, 20)
    assert fit_body(solved).skinned(0)[0][:, 1].min() == pytest.approx(0, abs=0.004)
    np.testing.assert_array_equal(drawn.joints[0], 0)
    # A rigid bone maps both its ends to joints
    moves = (drawn.turns[0, :22] @ drawn.joints[..., None])[..., 0]
    for parent, joint in SMPL22.edges:
        with subtests.test(joint=SMPL22.joints[joint]):
            end = (
                drawn.starts[0, parent]
                - moves[parent]
                + drawn.turns[0, parent] @ drawn.joints[joint]
            )
            assert np.linalg.norm(end - drawn.starts[0, joint]) < 1e-4, SMPL22.joints[joint]


@pytest.mark.parametrize(
    ("bones", "part", "sizes"),
    [
        (["neck"], "spine3", (1, 1.2, 1)),  # the neck ends the chest, not a collarbone
        (["spine1"], "pelvis", (1, 1.2, 1)),  # the spine ends the pelvis, not a hip
        (["left_collar", "right_collar"], "spine3", (None, 1, 1)),
        (["left_hip", "right_hip"], "pelvis", (1.2, 1, 1)),
        (["head"], "neck", (1, 1.2, 1)),
    ],
)
def test_parts_of_the_trunk_are_as_tall_as_their_bone_and_as_wide_as_the_hips_and_shoulders(
    bones: list[str], part: str, sizes: tuple[float | None, ...]
):
    offsets = mannequin().rest.copy()
    usual, wide = proportions(mannequin(), offsets)
    np.testing.assert_allclose(usual, np.tile(np.eye(3), (22, 1, 1)), atol=1e-6)
    assert wide == pytest.approx(1)
    offsets[[JOINT[bone] for bone in bones]] *= 1.2
    fit, wide = proportions(mannequin(), offsets)
    assert wide == pytest.approx(1)  # limbs alone determine the width
    along = mannequin().rest[JOINT[bones[0]]]
    for axis, size in enumerate(sizes):
        if size is not None and part != "neck":
            assert fit[JOINT[part]][axis, axis] == pytest.approx(size), axis
    if part == "neck":
        np.testing.assert_allclose(fit[JOINT[part]] @ along, 1.2 * along, atol=1e-6)


def test_a_limb_is_stretched_along_its_bone_and_as_thick_as_all_limbs():
    offsets = mannequin().rest.copy()
    knee = JOINT["left_knee"]
    limbs = [
        JOINT[f"{s}_{n}"] for s in ("left", "right") for n in ("knee", "ankle", "elbow", "wrist")
    ]
    lengths = np.linalg.norm(offsets[limbs], axis=1)
    offsets[knee] *= 1.5
    fit, wide = proportions(mannequin(), offsets)
    extra = 0.5 * np.linalg.norm(mannequin().rest[knee])
    assert wide == pytest.approx(1 + extra / lengths.sum())
    along = mannequin().rest[knee]
    across = np.cross(along, [0, 0, 1])
    thigh = fit[JOINT["left_hip"]]
    np.testing.assert_allclose(thigh @ along, 1.5 * along, atol=1e-9)
    np.testing.assert_allclose(thigh @ across, wide * across, atol=1e-9)


def test_a_twisted_wrist_turns_the_forearm_by_degrees_toes_bend_and_the_head_is_level():
    drawn = fit_body(posed(left_wrist=(80, 0, 0)))
    turned = degrees(drawn.turns[0] @ fit_body(posed()).turns[0].mT)
    helper = next(
        bone for bone, joint in enumerate(ANCHORS[22:], 22) if SMPL22.joints[joint] == "left_elbow"
    )
    assert turned[[JOINT["left_elbow"], helper, JOINT["left_wrist"]]] == pytest.approx(
        [0, 44, 80], abs=1.5
    )
    # toes bend where the heel rises, and the head is level, also after a long bow
    raised = posed(left_ankle=(40, 0, 0), left_knee=(10, 0, 0), neck=(25, 0, 0))
    raised.joints[:, :, 1] -= raised.joints[..., 10, 1].min()  # the toes stand on the floor
    drawn = fit_body(Motion(np.concatenate([posed(3, neck=(25, 0, 0)).joints, raised.joints]), 20))
    forward = drawn.turns @ mannequin().turns @ np.array([0.0, 0, 1])
    assert abs(forward[-1, JOINT["left_foot"], 1]) < 0.12
    assert forward[-1, JOINT["left_ankle"], 1] < -0.4
    assert abs(forward[0, JOINT["head"], 1]) < 0.05
    bowed = posed(30, pelvis=(70, 0, 0), neck=(30, 0, 0))
    drawn = fit_body(Motion(np.concatenate([bowed.joints, posed(10).joints]), 20))
    pitch = np.degrees(np.arcsin((drawn.turns @ mannequin().turns)[:, JOINT["head"], 1, 2]))
    assert pitch[-1] == pytest.approx(0, abs=2)
    assert pitch[0] < -60


def test_the_nearest_triangle_is_drawn_and_pictures_show_the_body_in_its_clothes():
    image = np.full((20, 20, 3), 255, np.uint8)
    square = np.array([[2.0, 18], [18, 18], [18, 2], [2, 2]])
    at, triangles = np.concatenate([square, square]), np.array([[0, 1, 2], [0, 2, 3]])
    colors = np.repeat([[10.0, 20, 30], [200, 100, 0]], 4, axis=0)
    render._rasterize(
        image, at, np.repeat([1.0, 2.0], 4), colors, np.concatenate([triangles, triangles + 4])
    )
    assert (image[2:18, 2:18] == [10, 20, 30]).all()
    assert (image[:, :2] == 255).all()
    assert (image[18:] == 255).all()
    # This side is seen from inside.
    render._rasterize(image, at, np.repeat([3.0, 0.5], 4), colors, triangles[:, ::-1])
    assert (image[2:18, 2:18] == [10, 20, 30]).all()
    # pictures show the body in its clothes
    image = frames_array(posed(), 192)[0].astype(int)
    blue = (image[..., 2] > image[..., 0] + 25).nonzero()[0]
    skin = (image[..., 0] > image[..., 2] + 30).nonzero()[0]
    assert min(len(blue), len(skin)) > 100
    assert skin.min() < blue.min()  # the face is above the shirt


def test_pixels_show_the_nearest_triangle_at_their_centers_with_mixed_colors():
    random = np.random.default_rng(0)
    at, depth = random.uniform(-4, 20, (15, 2)), random.uniform(1, 3, 15)
    colors, triangles = random.uniform(0, 255, (15, 3)), np.arange(15).reshape(5, 3)
    image = np.full((16, 14, 3), 255, np.uint8)
    expected = image.copy()
    for row, column in np.ndindex(16, 14):
        nearest = np.inf
        for corners in triangles:
            # shares of the corners: their sum is 1, and they mix the corners to the pixel's center
            system = np.vstack([at[corners].T, np.ones(3)])
            shares = np.linalg.solve(system, [column + 0.5, row + 0.5, 1])
            # y is down, so a triangle that is counterclockwise on the screen has a negative area
            if (
                np.linalg.det(system) < 0
                and shares.min() >= 0
                and shares @ depth[corners] < nearest
            ):
                nearest = shares @ depth[corners]
                expected[row, column] = shares @ colors[corners]
    render._rasterize(image, at, depth, colors, triangles)
    assert 20 < (expected != 255).any(2).sum() < 200
    assert np.abs(image.astype(int) - expected).max() <= 1


def test_a_motion_that_no_body_fits_says_why(subtests):
    drawn = posed().try_fit()[0]
    for motion, reason in (
        (
            posed(scale=3.0),
            r"left_knee is 1\.17 m long, but in the body model, this bone is 0\.392 m long\. Is the unit right\?",
        ),
        (sway(3, skeleton=KIT21), "computed only for SMPL's 22 joints"),
        (Motion(np.zeros((3, 22, 3)), 20), "has no length"),
    ):
        with subtests.test(reason=reason):
            with pytest.raises(ValueError, match=reason):
                fit_body(motion)
            assert motion.try_fit()[0] is None
            assert frames_array(motion, 64).shape == (len(motion.joints), 64, 64, 3)  # its skeleton
            assert render._lines(motion, None, 200, 200) == [
                *render._lines(motion, drawn, 200, 200),
                "(no body fits)",
            ]


def test_the_summary_of_a_picture_says_why_it_has_no_body(tmp_path):
    summary = posed().save(tmp_path / "a.gif")
    assert summary.endswith("animated GIF with at most 50 frames per second")
    summary = posed(scale=3.0).save(tmp_path / "a.gif")
    assert "per second; without a body: the bone that ends at left_knee is" in summary


@pytest.mark.parametrize(
    "matrix", [np.ones((3, 3)), np.zeros((3, 3)), -np.eye(3), np.full((3, 3), np.nan)]
)
def test_matrices_that_are_no_rotations_are_the_reason_for_a_skeleton_in_pictures_and_pages(
    matrix: np.ndarray,
):
    motion = posed(3)
    assert motion.poses is not None
    motion.poses.rotations[1, JOINT["left_knee"]] = torch.from_numpy(matrix)
    body, reason = motion.try_fit()
    assert body is None
    assert (
        reason == "the matrix of left_knee in frame 1 is not a rotation, so a body cannot be drawn"
    )
    assert reason in player_page([motion])
    assert frames_array(motion, 64).shape == (3, 64, 64, 3)


def test_errors_that_are_not_the_motions_are_not_taken_for_a_reason(monkeypatch):
    def faulty(*_: Any) -> None:
        raise ValueError("a mistake")

    monkeypatch.setattr(body_module, "proportions", faulty)
    with pytest.raises(ValueError, match="a mistake"):
        posed().try_fit()


def test_bodies_in_files_are_drawn_and_damaged_ones_named(tmp_path, subtests):
    stored: dict[str, Any] = mannequin().stored
    motion = posed(left_knee=(60, 0, 0), left_hip=(-30, 0, 0))
    np.savez(tmp_path / "other.npz", **stored | {"colors": 255 - stored["colors"]})
    body = load_body(str(tmp_path / "other.npz"))
    assert fit_body(motion, body).mesh is body
    for name in ("a.glb", "a.gif"):
        with subtests.test(name=name):
            assert motion.save(tmp_path / name, body=body).startswith(
                f"{tmp_path / name}: 1 frames at 20 per second, "
            )
            motion.save(tmp_path / f"mannequin_{name}")
            assert (tmp_path / name).read_bytes() != (tmp_path / f"mannequin_{name}").read_bytes()
    assert player_page([motion], body=body) != player_page([motion])
    (tmp_path / "a.npz").write_bytes(b"PK")
    np.savez(tmp_path / "b.npz", **stored | {"bones": stored["bones"] + 30})
    np.savez(tmp_path / "c.npz", points=stored["points"])
    for name in "abc":
        with subtests.test(name=name), pytest.raises(UserError, match=rf"{name}\.npz: "):
            load_body(str(tmp_path / f"{name}.npz"))


SIDES = (("L", "left"), ("R", "right"))


class StandIn:
    """Anny's interface with the mannequin's mesh; counts the bodies that are built."""

    built = 0

    def __init__(self, **options: str) -> None:
        assert options == {
            "rig": "anny",
            "topology": "notoes_collapse10pc",
            "skinning_method": "lbs",
        }
        StandIn.built += 1
        joints = {name: mannequin().joints[JOINT[name]] for name in SMPL22.joints}
        bones = [(bone, joint) for joint, bone in HEADS.items() if joint != "head"]
        bones += [("clavicle", "collar"), ("shoulder01", "collar")]
        heads = {
            f"{bone}.{letter}": joints[f"{side}_{joint}"]
            for bone, joint in bones
            for letter, side in SIDES
        }
        heads |= {"head": joints["head"], "neck01": joints["neck"] - [0, 0.02, 0]}
        spine = np.linspace(joints["pelvis"], heads["neck01"], 6)
        heads |= {f"spine0{5 - k}": spine[k] for k in range(5)}
        self.bone_labels, self.heads = list(heads), np.stack(list(heads.values()))
        distances = np.linalg.norm(mannequin().points[:, None] - self.heads, axis=-1)
        self.vertex_bone_indices = torch.from_numpy(distances.argmin(1)[:, None])
        self.vertex_bone_weights = torch.ones(len(distances), 1)
        self.faces = torch.from_numpy(mannequin().triangles)

    def __call__(self, phenotype_kwargs: dict[str, float]) -> dict[str, torch.Tensor]:
        size = 0.9 + 0.2 * phenotype_kwargs["height"]
        axes = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        return {
            key: torch.from_numpy(size * (points + np.array([0, 1, 0])) @ axes.T)[None]
            for key, points in (
                ("rest_vertices", mannequin().points),
                ("rest_bone_heads", self.heads),
            )
        }


def test_anny_is_made_once_and_fitted_like_the_mannequin(tmp_path, monkeypatch, subtests):
    monkeypatch.setattr(StandIn, "built", 0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "anny", SimpleNamespace(Anny=StandIn))
    body = load_body("anny height=0.9 gender=1")
    (file,) = (tmp_path / "flame-mdm").iterdir()
    load_body("anny gender=1 height=0.9")
    assert StandIn.built == 1
    assert load_body(str(file)).points.shape == body.points.shape == mannequin().points.shape
    motion = posed(left_knee=(60, 0, 0), left_hip=(-30, 0, 0))
    drawn = fit_body(motion, body)
    np.testing.assert_allclose(
        drawn.starts[0, :22] - [0, drawn.lift, 0], motion.joints[0], atol=1e-6
    )
    for name in ("a.glb", "a.gif"):
        with subtests.test(name=name):
            motion.save(tmp_path / name, body=body)
            motion.save(tmp_path / f"mannequin_{name}")
            assert (tmp_path / name).read_bytes() != (tmp_path / f"mannequin_{name}").read_bytes()


def test_shapes_that_anny_cannot_have_are_refused(tmp_path, monkeypatch, subtests):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "anny", None)
    for name, message in (
        (
            "anny age=old",
            "age=old is invalid. Use NAME=NUMBER, with a name from gender, age, height, weight and a number",
        ),
        ("anny age=1.1", r"age=1\.1 is invalid"),
        ("anny", r'body=anny requires the anny package\. Run pip install "flame-mdm\[body\]"'),
    ):
        with subtests.test(name=name, message=message), pytest.raises(UserError, match=message):
            load_body(name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("joint", "end", "share"),
    [
        ("right_hip", "right_knee", 0.4),
        ("left_shoulder", "left_elbow", 0.4),
        ("right_wrist", "right_wrist", 0.55),
    ],
)
def test_helper_bones_take_their_share_of_a_twist(joint: str, end: str, share: float):
    axis = np.array(ADULT[JOINT[end]]) / np.linalg.norm(ADULT[JOINT[end]])
    angles = Rotation.from_rotvec(50 * axis, degrees=True).as_euler("xyz", degrees=True)
    turned = fit_body(posed(**{joint: angles})).turns[0] @ fit_body(posed()).turns[0].mT
    helper = ANCHORS.index(JOINT[joint.replace("wrist", "elbow")], 22)
    vector = Rotation.from_matrix(turned[helper]).as_rotvec(degrees=True)
    np.testing.assert_allclose(vector, 50 * share * axis, atol=1e-3)


def test_weights_are_rounded_to_255_parts():
    weights = np.array(
        [[0.3, 0, 0.5, 0.2, 0], [0.001, 0.999, 0, 0, 0], [0.1, 0.15, 0.2, 0.25, 0.3]]
    )
    bones, parts = largest_weights(weights)
    assert parts.sum(1).tolist() == [255] * 3
    assert parts[:2].tolist() == [[127, 77, 51, 0], [255, 0, 0, 0]]
    assert bones.tolist() == [[2, 0, 3, 0], [1, 0, 0, 0], [4, 3, 2, 1]]
    assert parts[2].tolist() == [84, 71, 57, 43]


def test_a_flat_foot_is_as_deep_as_the_ankle_is_above_the_toes_while_both_are_low():
    offset = np.array([0.03, -0.02, 0.12])
    length, ahead = np.linalg.norm(offset), np.array([0.03, 0, 0.12]) / np.hypot(0.03, 0.12)
    cases = (([0.06] * 3, 0.06), ([0.0] * 3, 0.1 * length), ([0.2] * 3, 0.8 * length))
    for above, drop in cases:
        toe = np.zeros((9, 3))
        ankle = toe + np.array([0, 0.5, 0])  # the heel is high in most frames
        ankle[3:6, 1] = above
        flat = _flat_foot(ankle, toe, offset)
        expected = math.sqrt(length**2 - drop**2) * ahead - np.array([0, drop, 0])
        np.testing.assert_allclose(flat, expected, atol=1e-12)


def test_a_body_that_is_never_upright_has_a_level_head_on_average():
    bowed = Motion(posed(9, pelvis=(70, 0, 0)).joints, 20)
    neutral, world, _ = complete(
        bowed.joints.astype(float), np.array(ADULT[:22]), world_rotations(solved(bowed))
    )
    assert np.isfinite(neutral).all()
    assert np.isfinite(world).all()
    assert degrees(world[:, JOINT["head"]]).max() < 1


@pytest.mark.parametrize("heading", [-1.0, 0.7, 2.5])
def test_the_direction_of_a_level_head_does_not_depend_on_where_the_body_faces(heading: float):
    results = []
    for angle in (0.0, heading):
        motion = posed(5, heading=angle, neck=(25, 0, 10), spine3=(5, 0, 0))
        offsets = np.array(ADULT[:22])
        joints, world = motion.joints.astype(float), world_rotations(solved(motion))
        results.append(complete(joints, offsets, world)[0])
    np.testing.assert_allclose(results[1], results[0], atol=1e-5)
    assert degrees(results[0][JOINT["head"]]) > 10


def solved(motion: Motion) -> np.ndarray:
    return solve(torch.from_numpy(motion.joints), motion.fps).rotations.numpy()


@pytest.mark.parametrize("frames", [0.4, 3.0])
def test_bends_are_smoothed_by_a_gaussian_over_frames(frames: float):
    values = np.random.default_rng(0).normal(size=(40, 3))
    expected = gaussian_filter1d(values, frames, axis=0, mode="nearest")
    np.testing.assert_allclose(_smooth(torch.from_numpy(values), frames), expected, atol=1e-7)


def test_toes_bend_against_the_pitch_of_the_foot_until_it_leaves_the_floor():
    cases = {
        (40, 0.0): -40,
        (40, 0.02): -40,
        (40, 0.055): -20,
        (40, 0.09): 0,
        (80, 0.0): -60,
        (-30, 0.0): 0,
    }
    pitches, heights = np.array(list(cases)).T
    feet = Rotation.from_euler("x", pitches[:, None], degrees=True).as_matrix()
    bends = Rotation.from_matrix(_toes(feet, heights)).as_rotvec(degrees=True)
    np.testing.assert_allclose(bends[:, 0], list(cases.values()), atol=1e-9)
    np.testing.assert_allclose(bends[:, 1:], 0, atol=1e-9)


HIPS, ARMS = ["left_hip", "right_hip"], ["left_collar", "right_collar"]
ARMS += ["left_shoulder", "right_shoulder"]


@pytest.mark.parametrize(
    ("bones", "factor", "part", "axis", "size"),
    [
        (HIPS, 2.0, "pelvis", 0, 1.25),
        (HIPS, 0.5, "pelvis", 0, 0.8),
        (ARMS, 2.0, "spine3", 0, 1.25),
        (ARMS, 0.5, "spine3", 0, 0.8),
        (["neck"], 2.0, "spine3", 1, 1.6),
        (["neck"], 0.5, "spine3", 1, 0.6),
        # between hips and shoulders
        (HIPS, 1.2, "spine1", 0, 1.2 - 0.35 * 0.2),
        (HIPS, 1.2, "spine2", 0, 1.2 - 0.75 * 0.2),
        (HIPS, 1.2, "spine3", 0, 1.0),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_parts_of_the_trunk_have_limits_relative_to_the_limbs(
    scale: float, bones: list[str], factor: float, part: str, axis: int, size: float
):
    offsets = scale * mannequin().rest
    offsets[[JOINT[bone] for bone in bones]] *= factor
    fit, wide = proportions(mannequin(), offsets)
    assert wide == pytest.approx(scale)
    assert fit[JOINT[part]][axis, axis] == pytest.approx(scale * size)


@pytest.mark.parametrize("joint", ["left_knee", "right_wrist"])
@pytest.mark.parametrize(
    ("factor", "fits"), [(0.41, True), (0.39, False), (2.49, True), (2.51, False)]
)
def test_a_limb_may_have_two_fifths_to_five_halves_of_its_usual_length(joint, factor, fits):
    offsets = mannequin().rest.copy()
    offsets[JOINT[joint]] *= factor
    if fits:
        proportions(mannequin(), offsets)
        return
    with pytest.raises(UserError, match=f"the bone that ends at {joint} is"):
        proportions(mannequin(), offsets)


def test_a_body_of_anny_has_the_points_normals_and_axes_of_the_model(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", SimpleNamespace(Anny=StandIn))
    figure, size = bake(shape_of([])), 0.9 + 0.2 * 0.45
    points = figure["points"] / 20000
    moved = points - points[0]
    np.testing.assert_allclose(
        moved, size * (mannequin().points - mannequin().points[0]), atol=1e-4
    )
    normals = figure["normals"] / np.linalg.norm(figure["normals"], axis=1, keepdims=True)
    assert (normals * mannequin().normals).sum(1).mean() > 0.98
    np.testing.assert_array_equal(figure["triangles"], mannequin().triangles)
    joints, limbs = figure["joints"], [JOINT["left_knee"], JOINT["right_wrist"], JOINT["head"]]
    np.testing.assert_allclose(
        joints[limbs] - joints[JOINT["left_hip"]],
        size * (mannequin().joints[limbs] - mannequin().joints[JOINT["left_hip"]]),
        atol=1e-9,
    )
    turned = degrees(figure["turns"] @ mannequin().stored["turns"].mT)
    assert turned.max() < 35  # the feet differ most
    assert (figure["weights"].astype(int).sum(1) == 255).all()


def test_each_shape_of_anny_has_a_file_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("flame_mdm.formats.people.bake", lambda shape: mannequin().stored)
    shapes = ["", *(f" {name}={value}" for name in SHAPE for value in (0.1, 0.125))]
    for shape in shapes:
        load_body(f"anny{shape}")
    assert len(list((tmp_path / "flame-mdm").iterdir())) == len(shapes) == 9


def test_helper_bones_take_the_upper_part_of_a_limb_and_the_lower_part_of_a_forearm():
    joints, along = np.array(ADULT[:22]), np.array([0.1, 0.2, 0.475, 0.6, 0.75, 0.9])
    for side, (joint, is_forearm) in product(
        ("left", "right"), (("hip", False), ("shoulder", False), ("elbow", True))
    ):
        start = JOINT[f"{side}_{joint}"]
        end = SMPL22.parents.index(start)
        bone = joints[end] - joints[start]
        across = np.cross(bone, [0.3, 0.1, 1])  # the distance from the bone does not matter
        weights = np.zeros((len(along), 22))
        weights[:, start], weights[:, end] = 0.8, 0.2
        helped = with_helpers(joints[start] + along[:, None] * bone + across, weights, joints)
        share = np.clip((along - 0.2) / 0.55, 0, 1)
        share = share**2 * (3 - 2 * share)
        helper = ANCHORS.index(start, 22)
        expected = 0.8 * (share if is_forearm else 1 - share)
        np.testing.assert_allclose(helped[:, helper], expected, atol=1e-12)
        np.testing.assert_allclose(helped[:, start], 0.8 - expected, atol=1e-12)
        np.testing.assert_allclose(helped.sum(1), 1)


def test_numbers_of_a_shape_are_from_0_to_1_and_the_others_keep_their_defaults():
    assert shape_of([]) == {"gender": 0.5, "age": 2 / 3, "height": 0.45, "weight": 0.4}
    assert shape_of(["age=0", "gender=1", "age=0.5"]) == {**SHAPE, "gender": 1.0, "age": 0.5}
    assert shape_of(["weight=0"])["weight"] == 0.0
    for word in ("age=-0.01", "age=1.01", "age=nan", "age", "=1", "muscle=1"):
        with pytest.raises(UserError, match=rf"body=anny: {word} is invalid"):
            shape_of([word])


@pytest.mark.parametrize(
    ("bone", "joint"),
    [
        *(("spine05", "pelvis"), ("spine04", "spine1"), ("spine03", "spine1")),
        *(("spine02", "spine2"), ("spine01", "spine3"), ("neck03", "neck"), ("eye.L", "head")),
        *(("clavicle.L", "left_collar"), ("shoulder01.R", "right_collar")),
        *(("upperarm02.R", "right_shoulder"), ("lowerarm01.L", "left_elbow")),
        *(("finger2-1.R", "right_wrist"), ("metacarpal3.L", "left_wrist")),
        *(("upperleg02.L", "left_hip"), ("lowerleg02.R", "right_knee")),
        *(("foot.L", "left_ankle"), ("toe5-2.R", "right_foot"), ("breast.L", "pelvis")),
    ],
)
def test_bones_of_anny_follow_joints_on_their_side(bone: str, joint: str):
    assert SMPL22.joints[_owner(bone)] == joint


def test_joints_of_anny_are_where_its_bones_begin_and_the_trunk_is_divided_like_smpls():
    rng = np.random.default_rng(0)
    heads = {
        f"{bone}.{letter}": rng.normal(size=3)
        for joint, bone in [*HEADS.items(), ("collar", "clavicle"), ("collar", "shoulder01")]
        if joint != "head"
        for letter, _ in SIDES
    }
    heads["upperleg01.L"][1] = 1.0
    heads |= {"head": np.array([0, 1.7, 0.05]), "neck01": np.array([0, 1.48, -0.04])}
    bends = [0.0, 0.03, 0.05, 0.02, -0.02]
    for k, bend in zip((5, 4, 3, 2, 1), bends, strict=True):
        heads[f"spine0{k}"] = np.array([0, 0.95 + 0.1 * (5 - k), bend])
    joints = _joints(heads)
    for joint, bone in HEADS.items():
        if joint == "head":
            np.testing.assert_array_equal(joints[JOINT["head"]], heads["head"])
            continue
        for letter, side in SIDES:
            np.testing.assert_array_equal(
                joints[JOINT[f"{side}_{joint}"]], heads[f"{bone}.{letter}"]
            )
    for letter, side in SIDES:
        middle = (heads[f"clavicle.{letter}"] + heads[f"shoulder01.{letter}"]) / 2
        np.testing.assert_allclose(joints[JOINT[f"{side}_collar"]], middle)
    np.testing.assert_allclose(joints[JOINT["neck"]], [0, 1.5, -0.04])
    # Heights from the hips, at 1 m, to the neck, at 1.5 m; the spine is bent
    heights, bent = [0.95, 1.05, 1.15, 1.25, 1.35, 1.48], [*bends, -0.04]
    for joint, share in (
        ("pelvis", 0.137),
        ("spine1", 0.339),
        ("spine2", 0.565),
        ("spine3", 0.653),
    ):
        height = 1 + 0.5 * share
        expected = [0, height, np.interp(height, heights, bent)]
        np.testing.assert_allclose(joints[JOINT[joint]], expected, atol=1e-12)


def test_vertices_of_anny_wear_the_clothes_of_their_joints():
    """A head that is as large as the mannequin's has hair where the mannequin has it."""
    skin, hair, shirt, trousers, shoes = (np.array(color, float) for color in MATERIALS)
    figure, head = mannequin(), JOINT["head"]
    of_head = figure.points[figure.weights[:, head] > 0.5]
    worn = {
        **{"pelvis": trousers, "left_hip": trousers, "right_knee": trousers},
        **{"left_ankle": shoes, "right_foot": shoes, "neck": skin, "right_wrist": skin},
        **{"spine3": shirt, "left_shoulder": shirt, "right_elbow": shirt, "left_collar": shirt},
    }
    weights = np.zeros((len(of_head) + len(worn) + 1, 22))
    weights[: len(of_head), head] = 1
    for row, joint in enumerate(worn, len(of_head)):
        weights[row, JOINT[joint]] = 1
    weights[-1, [JOINT["left_knee"], JOINT["left_ankle"]]] = [0.75, 0.25]
    points = np.concatenate([of_head, np.zeros((len(worn) + 1, 3))])
    colors = _clothes(points, weights)
    for color, (joint, expected) in zip(colors[len(of_head) :], worn.items(), strict=False):
        np.testing.assert_allclose(color, expected, err_msg=joint)
    np.testing.assert_allclose(colors[-1], 0.75 * trousers + 0.25 * shoes)
    top, face = of_head[:, 1].argmax(), of_head[:, 2].argmax()
    np.testing.assert_allclose(colors[top], hair, atol=1)
    np.testing.assert_allclose(colors[face], skin, atol=1)
    usual = figure.colors[figure.weights[:, head] > 0.5]
    assert np.abs(colors[: len(of_head)] - usual).mean() < 6
