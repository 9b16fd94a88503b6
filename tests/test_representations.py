import itertools
import math
import re
from collections.abc import Callable
from inspect import signature

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support.fixtures import (
    ROOT,
    SHARED,
    Arrays,
    golden,
    golden_case,
    groups,
    meta,
    needs_third_party,
    tensors,
    third_party,
)
from support.motions import posed
from torch import Tensor
from torch.nn import functional

from flame_mdm.data.standing import standing
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation, grouped_statistics, rotation
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272, face_forward
from flame_mdm.representations.rifke import Rifke, upsample
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.rotation import is_degenerate
from flame_mdm.representations.skeleton import (
    SKELETONS,
    SMPL22,
    SMPL24,
    forward_kinematics,
    global_rotations,
)
from flame_mdm.representations.smpl import ADULT, SMPL

STEMS = ["hml263", "kit251"]
STEMS += [
    pytest.param(f"third_party-{stem}", marks=needs_third_party)
    for stem in ("hml263", "hml263_bandai")
]


def arrays(stem: str) -> Arrays:
    return (
        third_party(stem.removeprefix("third_party-")) if stem.startswith("third") else golden(stem)
    )


def cases(stem: str, *keys: str) -> list[list[Tensor]]:
    """These arrays of all clips of a fixture that have the first one."""
    file = tensors(arrays(stem))
    return [[file[f"{clip}/{key}"] for key in keys] for clip in groups(arrays(stem), keys[0])]


def legacy(stem: str) -> tuple[HumanML, Tensor]:
    """The published features of a fixture, in its own units, and the bone lengths of its target skeleton."""
    lengths = torch.from_numpy(np.linalg.norm(arrays(stem)["tgt_offsets"], axis=-1))
    if stem.startswith("kit"):
        return HumanML(
            "kit21", "legacy", fps=12.5, bone_lengths=lengths.tolist(), contact_threshold=0.05
        ), lengths
    return HumanML("smpl22", "legacy", bone_lengths=lengths.tolist()), lengths


def canonicalize(representation: HumanML, motion: Tensor) -> Tensor:
    """Canonical joints (T, J, 3) float64 of joints (T, J, 3) in meters, which features decode to."""
    return representation._canonical([motion])[0] / representation.units_per_metre


def decode_rotations(representation: HumanML, features: Tensor, bone_lengths: Tensor) -> Tensor:
    """Features (..., F, D) -> joints (..., F, J, 3), from turn, root, rotations and the lengths (J,) of bones."""
    heading, root = representation._root(features)
    skeleton, legacy = representation.skeleton, representation.legacy
    facing = torch.zeros_like(root)
    facing[..., 1] = -heading if legacy else heading
    local = features[..., representation.slices["rotations"]].unflatten(-1, (-1, 6))
    local = rotation.rot6d_to_matrix(local, "columns")
    local = torch.cat([rotation.axis_angle_to_matrix(facing)[..., None, :, :], local], -3)
    turned = global_rotations(local, skeleton.chain_parents if legacy else skeleton.parents)
    offsets = features.new_tensor(skeleton.raw_offsets) * bone_lengths[:, None]
    return skeleton.assemble(
        (turned @ offsets[..., None])[..., 0], root / representation.units_per_metre
    )


def close(actual: Tensor, expected: Tensor, atol: float) -> None:
    torch.testing.assert_close(actual.double(), expected.double(), atol=atol, rtol=0)


def yaw_quaternion(angle: Tensor) -> Tensor:
    return rotation.axis_angle_to_quaternion(functional.pad(angle[..., None], (1, 1)))


def wander(skeleton: str = "smpl22", frames: int = 60, seed: int = 0, turns: float = 2.0) -> Tensor:
    """A body of random proportions that bends its joints and walks a full circle `turns` times. Meters, float64."""
    rng = torch.Generator().manual_seed(seed)
    body = SKELETONS[skeleton]
    time = torch.linspace(0, 1, frames, dtype=torch.float64)
    size = 0.05 + 0.4 * torch.rand(len(body), 1, generator=rng, dtype=torch.float64)
    amplitude = 0.3 * torch.randn(len(body), 3, generator=rng, dtype=torch.float64)
    phase = torch.rand(len(body), 1, generator=rng, dtype=torch.float64)
    amplitude[0] = 0
    bend = amplitude * torch.sin(2 * math.pi * (2 * time[:, None, None] + phase))
    bend[:, 0, 1] = 2 * math.pi * turns * time
    across = torch.stack(
        [torch.sin(bend[:, 0, 1]), 0.2 * torch.sin(9 * time), torch.cos(bend[:, 0, 1])], -1
    )
    offsets = torch.tensor(body.raw_offsets, dtype=torch.float64) * size
    return forward_kinematics(body, rotation.axis_angle_to_matrix(bend), offsets, across)


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["hml263", "kit251"])
def test_skeleton_constants_and_mirrored_joints(stem: str, subtests):
    skeleton = legacy(stem)[0].skeleton
    assert skeleton.parents == tuple(arrays(stem)["parents"])
    assert np.array_equal(skeleton.raw_offsets, arrays(stem)["raw_offsets"])
    if "kinematic_chain_padded" in arrays(stem):
        assert skeleton.chains == tuple(
            tuple(c[c >= 0].tolist()) for c in arrays(stem)["kinematic_chain_padded"]
        )
    for clip in groups(arrays(stem), "joints_in"):
        with subtests.test(clip=clip):
            if clip.endswith("_mirror"):
                joints = torch.from_numpy(arrays(stem)[f"{clip.removesuffix('_mirror')}/joints_in"])
                assert np.array_equal(SMPL22.mirror(joints), arrays(stem)[f"{clip}/joints_in"])


def test_skeletons_are_trees(subtests):
    for name, skeleton in SKELETONS.items():
        with subtests.test(name=name, skeleton=skeleton):
            assert (
                len(set(skeleton.joints))
                == len(skeleton.parents)
                == len(skeleton.raw_offsets)
                == len(skeleton)
            ), name
            assert skeleton.parents[0] == -1
            assert all(0 <= parent < joint for parent, joint in skeleton.edges)
            in_chains = [edge for chain in skeleton.chains for edge in itertools.pairwise(chain)]
            assert sorted(in_chains) == sorted(skeleton.edges), "the chains walk every bone once"
            joints = wander(name)
            assert torch.equal(skeleton.mirror(skeleton.mirror(joints)), joints)
            exchanged = sum(a != b for a, b in enumerate(skeleton.mirrored))
            assert exchanged == 2 * sum("left" in joint for joint in skeleton.joints)
            close(skeleton.assemble(skeleton.bones(joints), joints[:, 0]), joints, 1e-12)


@pytest.mark.golden
@pytest.mark.parametrize("stem", STEMS)
def test_published_features_and_the_steps_to_and_from_them(stem: str, subtests):
    (representation, lengths), atol = legacy(stem), 5e-3 if stem.startswith("kit") else 2e-5
    tolerances = {"rotations": 1e-4, "contacts": 0.0, "turn": min(atol, 1e-4)}
    for number, (joints, expected) in enumerate(cases(stem, "joints_in", "feats")):
        with subtests.test(case=number):
            features = representation.encode(joints)
            assert features.dtype == torch.float32
            assert features.shape == expected.shape == (len(expected), representation.features)
            for name, columns in representation.slices.items():
                close(features[:, columns], expected[:, columns], tolerances.get(name, atol))

    for expected, joints in cases(stem, "global_positions", "joints_in"):
        close(canonicalize(representation, joints), expected, atol)
    for expected, joints in cases(stem, "uniform", "joints_in"):
        one_clip = torch.zeros(len(joints), dtype=torch.int64)
        close(
            representation._retarget(joints.double(), torch.tensor([0]), one_clip), expected, atol
        )
    for expected, joints in cases(stem, "ik_root", "global_positions"):
        actual = yaw_quaternion(-representation._heading(joints.double()))
        close(actual * (actual * expected).sum(-1, keepdim=True).sign(), expected, 1e-5)

    for expected, features in cases(stem, "rec_ric", "feats"):
        close(representation.decode(features), expected, atol)
    for expected, position, features in cases(stem, "root_quat", "root_pos", "feats"):
        heading, root = representation._root(features)
        close(yaw_quaternion(-heading), expected, 1e-5)
        close(root, position, atol)
    for expected, features in cases(stem, "rec_rot", "feats"):
        close(decode_rotations(representation, features, lengths), expected, atol)


@needs_third_party
@golden_case("third_party-hml263")
def test_published_statistics_and_normalization(stem: str):
    representation, _ = legacy(stem)
    ((*normed, features, joints),) = cases(stem, "normed", "normed_eval", "feats", "joints")
    portable = dict(np.load(SHARED / "golden" / "portable" / "hml263.npz"))
    clips = [
        portable[f"{clip}/feats"] for clip in groups(portable, "feats") if "mirror" not in clip
    ]
    statistics = representation.statistics(
        torch.from_numpy(np.concatenate([features.numpy(), *clips]))
    )
    for ours, theirs in zip(statistics, *cases(stem, "mean", "std"), strict=True):
        close(ours, theirs, 1e-5)  # the published one sums in float32
    for prefix, expected in zip(("", "eval_"), normed, strict=True):
        representation.mean = torch.from_numpy(arrays(stem)[f"{prefix}mean"])
        representation.std = torch.from_numpy(arrays(stem)[f"{prefix}std"])
        close(representation.normalize(features), expected, 2e-5)
        close(representation.denormalize(representation.normalize(features)), features, 1e-5)
        close(representation.to_joints(representation.normalize(features)), joints, 2e-5)


def test_clean_motions_are_canonical_and_come_back_also_with_bones_opposite_to_their_rest(subtests):
    for skeleton, turns in itertools.product(SKELETONS, (-2.0, 0.0, 0.5, 2.0)):
        representation = HumanML(skeleton)
        joints = wander(skeleton, frames=120, turns=turns)
        features, canonical = representation.encode(joints), canonicalize(representation, joints)
        close(representation.decode(features), canonical[:-1], 1e-5)
        lengths = representation.skeleton.bones(canonical[0]).norm(dim=-1)
        close(decode_rotations(representation, features.double(), lengths), canonical[:-1], 1e-5)
        close(representation._root(features.double())[1], canonical[:-1, 0], 1e-5)

    for skeleton in SKELETONS:
        with subtests.test(skeleton=skeleton):
            representation = HumanML(skeleton)
            joints = rotation.rotate_y(wander(skeleton), torch.tensor(2.0)) + torch.tensor(
                [3.0, -1.0, 5.0]
            )
            canonical = canonicalize(representation, joints)
            assert canonical[..., 1].min() == 0
            close(canonical[0, 0, ::2], torch.zeros(2), 1e-12)
            right_hip, left_hip, right_shoulder, left_shoulder = canonical[
                0, list(representation.skeleton.facing)
            ]
            across = right_hip - left_hip + right_shoulder - left_shoulder
            assert across[2].item() == pytest.approx(0, abs=1e-9)
            assert across[0] < 0, "facing +z, the right side is at -x"
            close(representation.encode(wander(skeleton)), representation.encode(joints), 1e-5)

    representation = HumanML()
    for tilt in (0.0, 1e-9, 1e-4):
        with subtests.test(tilt=tilt):
            joints = wander(turns=0)  # a thigh straight up is opposite to its rest direction
            joints = rotation.rotate_y(
                joints, -torch.atan2(*representation._facing(joints).unbind(-1))[:, None]
            )
            lengths = representation.skeleton.bones(joints[0]).norm(dim=-1)
            offset = joints[:, 4] - joints[:, 1]
            joints[:, [4, 7, 10]] += torch.tensor([tilt, lengths[4].item(), 0]) - offset[:, None]
            features, canonical = (
                representation.encode(joints),
                canonicalize(representation, joints),
            )
            close(
                decode_rotations(representation, features.double(), lengths), canonical[:-1], 1e-5
            )
            assert HumanML(variant="legacy").encode(joints).isfinite().all()


def test_headings_are_smoothed_over_the_same_seconds_at_any_rate():
    turned = []
    for fps in (20, 60):
        seconds = torch.arange(4 * fps) / fps
        joints = posed(4 * fps, heading=(2.0 * seconds).sin().numpy()).joints
        features = HumanML(fps=fps).encode(torch.from_numpy(joints))
        turned.append(features[:, 0].cumsum(0)[fps // 20 - 1 :: fps // 20])
    assert turned[0].abs().max() > 0.1
    # The ends differ: the last frames are not at the same time
    close(turned[0], turned[1][: len(turned[0])], 0.06)


def test_smoothing_of_the_heading_is_a_gaussian_of_one_second():
    """It damps a swing of one radian per second by exp(-1/2)."""
    seconds = np.arange(400) / 20
    joints = posed(400, heading=0.5 * np.sin(seconds)).joints
    heading = HumanML().encode(torch.from_numpy(joints))[:, 0].cumsum(0)[100:300]
    swing = (heading.max() - heading.min()).item()
    assert swing == pytest.approx(math.exp(-0.5), rel=0.01)


def test_a_steady_turn_stays_steady_to_the_first_and_last_frame():
    joints = posed(60, heading=0.1 * np.arange(60)).joints
    turn = HumanML().encode(torch.from_numpy(joints))[:, 0]
    close(turn, torch.full((59,), 0.1), 1e-4)


@pytest.mark.parametrize("variant", ["clean", "legacy"])
@pytest.mark.parametrize("units", [1.0, 640.0])
def test_steps_of_the_root_are_meters_to_the_left_and_ahead(variant, units):
    representation = HumanML(variant=variant, units_per_metre=units)
    path = np.arange(40)[:, None] * [0.02, 0.0, 0.05] + [0, 0.95, 0]
    features = representation.encode(torch.from_numpy(posed(40, root=path).joints))
    turn, step = representation.root_steps(features)
    close(turn, torch.zeros(39), 1e-4)
    close(step, torch.tensor([[0.02, 0.05]]).expand(39, 2), 1e-4)

    joints = posed(200, heading=0.02 * np.arange(200) - 2).joints
    turn, _ = representation.root_steps(representation.encode(torch.from_numpy(joints)))
    close(turn[90:110], torch.full((20,), 0.02), 2e-3)


def test_features_of_a_joint_are_its_columns():
    expected = {
        "humanml": [*range(13, 16), *range(67 + 18, 67 + 24), *range(193 + 12, 193 + 15)],
        "rifke": [10, 11, 12],
        "rot6d": [*range(24, 30)],
        "smpl": [*range(27, 33)],
    }
    for representation, (name, columns) in zip(
        (HumanML(), Rifke(), Rot6D(), SMPL()), expected.items(), strict=True
    ):
        assert representation.joint_features([4]).nonzero()[:, 0].tolist() == columns, name
    feet = [HumanML().joint_features([joint])[259:].tolist() for joint in SMPL22.feet]
    assert feet == torch.eye(4).bool().tolist()
    root = Rifke().joint_features([0]).nonzero()[:, 0].tolist()
    assert root == [0, 61, 62, 63]


def test_a_small_deviation_is_kept_and_a_smaller_one_counts_as_rounding():
    signs = torch.tensor([1.0, -1.0]).repeat(50)[:, None]
    features = signs * torch.tensor([1.1e-4, 0.9e-4, 3.0, 1.0])
    groups = [slice(0, 1), slice(1, 2), slice(2, 4)]
    _, std = grouped_statistics(features, groups)
    close(std, torch.tensor([1.1e-4, 1.0, 2.0, 2.0]), 1e-6)


def test_motion272_shows_the_body_of_smpl_from_another_side():
    """Up to a turn about the vertical axis and a shift, without a reflection."""
    generator = torch.Generator().manual_seed(0)
    turns = 0.5 * torch.randn(24, 3, generator=generator) * torch.linspace(0, 1, 9)[:, None, None]
    turns[:, 0] += torch.tensor([math.pi / 2, 0, 0])
    path = torch.linspace(0, 1, 9)[:, None] * torch.tensor([1.0, 2.0, 0.1])
    raw = torch.cat([path, turns.flatten(1)], 1).double()
    ours = Motion272().decode(Motion272().encode(raw).double())
    expected = SMPL().decode(SMPL().encode(raw).double())[:, :22]
    ours, expected = (joints - joints[:1, :1] for joints in (ours, expected))
    across, apart = ours[0, 2] - ours[0, 1], expected[0, 2] - expected[0, 1]
    angle = torch.atan2(across[0], across[2]) - torch.atan2(apart[0], apart[2])
    close(rotation.rotate_y(expected, angle), ours, 1e-5)


@pytest.mark.parametrize(
    ("name", "fps", "facts"),
    [
        ("essential67", 20, {"legacy": False, "units_per_metre": 1.0, "bone_lengths": None}),
        ("humanml_clean", 20, {"legacy": False, "units_per_metre": 1.0, "bone_lengths": None}),
        (
            "humanml_legacy",
            20,
            {"legacy": True, "units_per_metre": 1.0, "contact_threshold": 0.002},
        ),
        ("kit_legacy", 12.5, {"legacy": True, "units_per_metre": 640, "contact_threshold": 0.05}),
        ("motion272", 30, {}),
        ("rifke", 12.5, {"units_per_metre": 640}),
        ("rot6d", 20, {"offsets": ADULT}),
        ("smpl", 20, {"offsets": ADULT}),
    ],
)
def test_recipes_have_the_published_rates_and_units(name, fps, facts):
    representation = instantiate(OmegaConf.load(ROOT / f"experiments/representation/{name}.yaml"))
    assert representation.fps == fps
    assert {key: getattr(representation, key) for key in facts} == facts


def test_many_motions_at_once_are_encoded_as_one_by_one(subtests):
    motions = [wander(frames=frames, seed=frames, turns=frames / 30) for frames in (3, 41, 20)]
    for representation in (
        HumanML(bone_lengths=[0.2] * 22),
        HumanML(variant="legacy"),
        Essential(),
    ):
        with subtests.test(representation=representation):
            for many, motion in zip(representation.encode_many(motions), motions, strict=True):
                assert torch.equal(many, representation.encode(motion))


def test_statistics():
    representation = HumanML()
    features = torch.randn(500, 263, generator=torch.Generator().manual_seed(0)) * torch.linspace(
        0.1, 3, 263
    )
    features[:, representation.slices["contacts"]] = 1.0
    features[:, representation.slices["root_height"]] = 0.9
    mean, std = representation.statistics(features)
    close(mean, features.mean(0), 1e-6)
    for name, columns in representation.slices.items():
        average = features[:, columns].std(0, unbiased=False).mean().item()
        expected = 1.0 if name in ("contacts", "root_height") else average
        close(std[columns], torch.full_like(std[columns], expected), 1e-6)


def test_bad_motions_and_options(subtests):
    bent, raw = torch.zeros(5, 22, 3), torch.zeros(4, 75)
    for representation, motion, message in (
        (HumanML(), bent[:2], "2 frames"),
        (HumanML(), bent[:, :21], r"\(frames, 22, 3\).*\(5, 21, 3\)"),
        (
            HumanML(),
            bent.index_fill(0, torch.tensor([3]), math.inf),
            "frame 3 contains NaN or infinite values",
        ),
        (SMPL(), raw[:, :69], r"\(4, 69\)"),
        (Rot6D(), raw[:0], r"\(0, 75\)"),
        (Motion272(), raw[:1], "1 frame, but encoding requires at least 2"),
        (Rifke(), bent, r"shape \(frames, 21, 3\) for rifke, but found \(5, 22, 3\)"),
    ):
        with subtests.test(motion=motion, message=message):
            with pytest.raises(UserError, match=message):
                representation.encode(motion)
            if isinstance(representation, HumanML):
                with pytest.raises(UserError, match=f"motion 1: .*{message}"):
                    representation.encode_many([wander(), motion])
    for fps in (1, 12.5, 1000):
        assert Rifke(fps=fps).fps == fps
    for fps in (0.99, 1000.5, math.nan, math.inf):
        with (
            subtests.test(fps=fps),
            pytest.raises(UserError, match=f"representation.fps={fps}: expected 1 to 1000"),
        ):
            Rifke(fps=fps)
    with pytest.raises(UserError, match="bone_lengths: got 2 numbers, but smpl22 has 22 joints"):
        HumanML(bone_lengths=[1.0, 2.0])
    with pytest.raises(UserError, match=r"smpl23.*smpl22"):
        HumanML("smpl23")


@needs_third_party
@golden_case("smpl147")
def test_flame_features_of_published_samples(stem: str):
    file = tensors(third_party(stem))
    for clip in groups(third_party(stem), "feats147"):
        features = SMPL().encode(
            torch.cat([file[f"{clip}/translation"], file[f"{clip}/axis_angle"].flatten(1)], 1)
        )
        close(features, file[f"{clip}/feats147"], 4e-4)  # as stored by their authors


@golden_case("smpl147")
def test_flame_features_and_action_features_of_consecutive_skipped_and_all_frames(stem: str):
    file = tensors(golden(stem))
    features = SMPL().encode(torch.cat([file["prep/trans"], file["prep/poses156"]], 1))
    assert features.dtype == torch.float32
    close(features, file["prep/feats147"], 2e-6)
    cases = [re.fullmatch(r"a2m/(|rc_|full_)inp_(\w+)", key) for key in file]
    for kind, number in [case.groups() for case in cases if case]:
        motion = torch.cat([file[f"a2m/joints3d_{number}"][:, 0], file[f"a2m/pose72_{number}"]], 1)
        # From (25, 6, F) to (F, 150).
        expected = file[f"a2m/{kind}inp_{number}"].permute(2, 0, 1).flatten(1)
        if kind == "":
            start = max(int(file[f"a2m/shift_draw_{number}"][2]), 0)
            motion = motion[(start + torch.arange(len(expected))).clamp(max=len(motion) - 1)]
        elif kind == "rc_":
            step, start = (int(draw[2]) for draw in file[f"a2m/rc_draws_{number}"])
            motion = motion[start::step][: len(expected)]
        close(Rot6D().encode(motion), expected, 2e-6)


def test_every_recipe_builds_decodes_and_passes_gradients(subtests):
    for path in sorted(ROOT.glob("experiments/representation/*.yaml")):
        with subtests.test(path=path):
            representation = instantiate(OmegaConf.load(path))
            assert isinstance(representation, Representation), path
            size, joints = representation.features, len(representation.skeleton)
            assert representation.mean.shape == representation.std.shape == (size,)
            x = torch.randn(2, 5, size, requires_grad=True)
            decoded = representation.to_joints(x)
            assert decoded.shape == (2, 5, joints, 3)
            longer = representation.to_joints(torch.cat([x, torch.randn(2, 3, size)], 1))
            close(longer[:, :5], decoded, 1e-5)  # padding does not reach the frames before it
            close(representation.to_joints(x[1]), decoded[1], 1e-5)
            (gradient,) = torch.autograd.grad(decoded.square().sum(), x)
            assert gradient.isfinite().all()
            assert gradient.any()
            owners = torch.stack(
                [representation.joint_features([joint]) for joint in range(joints)]
            )
            assert owners.shape == (joints, size)
            assert (owners.sum(0) >= 1).all()


def test_features_of_a_joint_of_motion272_are_its_position_velocity_and_rotation():
    representation, joint = Motion272(), 4
    columns = []
    for name, width in (("positions", 3), ("velocities", 3), ("rotations", 6)):
        begin = representation.slices[name].start + width * joint
        columns += range(begin, begin + width)
    assert representation.joint_features([joint]).nonzero()[:, 0].tolist() == columns


@golden_case("temos64")
def test_features_floor_heading_and_joints_are_temos(stem: str, subtests):
    rifke, file, atol = Rifke(), tensors(golden(stem)), 2e-3  # in KIT's unit, about 1.6 mm
    clips = {
        name: file[f"{name}/joints_in"].double() / 640 for name in groups(golden(stem), "joints_in")
    }
    for name, joints in clips.items():
        close(rifke.encode(joints), file[f"{name}/feats"], atol)
        close(rifke.floor(joints * 640)[None], file[f"{name}/floor"], atol)
        heading = rifke.heading(joints * 640)
        close(torch.stack([heading.sin(), heading.cos()], 1), file[f"{name}/forward_used"], 1e-5)
        # the soft floor depends on the unit
        meters = Rifke(units_per_metre=1.0).encode(joints * 0.64)
        close(meters, file[f"{name}/feats_metres_input"], 1e-5)
        close(rifke.decode(file[f"{name}/feats"].double()) * 640, file[f"{name}/joints_back"], atol)
    close(rifke.decode(file["gen/feats"].double()) * 640, file["gen/joints_back"], atol)
    close(upsample(file["upsample/in"].double()), file["upsample/out_12.5_to_100"], 1e-9)
    # padding enters the floor of a batch in TEMOS
    features = file["batch/feats_padded"]
    for row, length in enumerate(file["batch/lengths"].tolist()):
        with subtests.test(row=row):
            same = [clip for clip in clips.values() if len(clip) == length]
            padded = [
                functional.pad(clip, (0, 0, 0, 0, 0, features.shape[1] - length)) for clip in same
            ]
            assert (
                min((rifke.encode(p)[:length] - features[row, :length]).abs().max() for p in padded)
                < atol
            )
    close(rifke.decode(features.double()) * 640, file["batch/joints_back_padded"], atol)
    x = file["norm/feats_clip0"]
    rifke.mean.copy_(file["norm/mean"])
    rifke.std.copy_(file["norm/std"])
    ours = rifke.normalize(rifke.encode(next(iter(clips.values()))))
    close(ours * rifke.std, x * rifke.std, 2e-3)
    close(rifke.to_joints(x) * 640, file["norm/joints_back_clip0"], 5e-3)


@golden_case("motion272")
def test_motion272_is_the_authors(stem: str):
    representation, file = (
        Motion272(),
        {key: value.double() for key, value in tensors(golden(stem)).items()},
    )

    def pose(name: str) -> tuple[Tensor, Tensor]:
        values = file[name]  # 22 axis-angles, 6 zeros and a translation
        return values[:, 72:75], rotation.axis_angle_to_matrix(values[:, :66].unflatten(1, (22, 3)))

    def cases(suffix: str) -> list[str]:
        return [
            name.partition("/")[2]
            for name in groups(golden(stem), suffix)
            if not name.startswith("f64/")
        ]

    for case in cases("face_z"):
        translation, rotations = face_forward(*pose(f"in/{case}/smpl_85"))
        theirs, turned = pose(f"out/{case}/face_z")
        close(translation, theirs, 5e-6)
        close(rotations, turned, 1e-5)
        features = representation.features_of(file[f"in/{case}/joints"], turned)
        close(features, file[f"out/{case}/feats"], 2e-6)
    for case in cases("rec_positions"):
        features = file[f"{'in' if f'in/{case}/feats' in file else 'out'}/{case}/feats"]
        close(representation.decode(features), file[f"out/{case}/rec_positions"], 5e-6)
        pelvis, rotations = representation.poses(features)
        theirs, turned = pose(f"f64/{case}/rec_smpl_85")
        close(pelvis, theirs, 1e-5)
        close(rotations, turned, 1e-5)
    frames = torch.cat(
        [file[f"out/{case}/feats"] for case in meta(golden(stem))["config"]["stats_over"]]
    )
    for ours, name in zip(representation.statistics(frames.float()), ("mean", "std"), strict=True):
        close(ours, file[f"out/stats/{name}"], 1e-6)


@golden_case("essential67")
def test_essential_features_are_the_first_of_humanml_and_the_authors(stem: str):
    file = tensors(golden(stem))
    features, representation = file["in/feats"], Essential(variant="legacy")
    representation.mean, representation.std = file["in/mean"], file["in/std"]
    real = torch.arange(features.shape[1]) < file["in/lengths"][:, None]
    x = representation.normalize(features[..., : representation.features]) * real[..., None]
    close(x, file["out/normed"], 5e-6)
    close(representation.denormalize(x), file["out/inv"], 5e-6)
    close(representation.decode(features[..., :67]), file["out/joints_from_67"], 5e-6)
    kit = Essential("kit21", "legacy")
    assert torch.equal(file["in/kit_feats"][..., : kit.features], file["out/kit_slice"])
    joints, representation, whole = wander(frames=30), Essential(), HumanML()
    features = representation.encode(joints)
    assert torch.equal(features, whole.encode(joints)[:, :67])
    assert torch.equal(representation.decode(features), whole.decode(whole.encode(joints)))
    assert representation.part_of == whole.name != representation.name


def test_cuts_of_motion272_start_like_whole_motions():
    """A body of 24 joints, z up, walks in a circle and bends its joints."""
    time = torch.linspace(0, 1, 50, dtype=torch.float64)
    turns = (
        0.4
        * torch.randn(24, 3, generator=torch.Generator().manual_seed(0))
        * torch.sin(6 * time)[:, None, None]
    )
    turns[:, 0] = torch.stack([torch.pi / 2 + 0 * time, 5 * time, 0 * time], 1)
    way = torch.stack(
        [3 * torch.sin(5 * time), 3 * torch.cos(5 * time), 1 + 0.1 * torch.sin(20 * time)], 1
    )
    representation = Motion272()
    features = representation.encode(torch.cat([way, turns.flatten(1)], 1))
    cut = representation.rebase(features[20:])
    close(cut[1:], features[21:], 0)
    for name in ("root_velocity", "turn", "velocities"):
        close(cut[0, representation.slices[name]], features[0, representation.slices[name]], 0)
    assert not is_degenerate(representation.rotations6d(cut)).any()
    joints, whole = (
        representation.decode(cut.double()),
        representation.decode(features.double())[20:],
    )
    assert joints[0, 0, [0, 2]].abs().max() == 0
    distances, expected = (
        torch.cdist(points, points) for points in (joints.flatten(0, 1), whole.flatten(0, 1))
    )
    close(distances, expected, 1e-4)


@pytest.mark.parametrize("representation", [HumanML(), Rifke(), Essential("kit21", fps=12.5)])
def test_a_person_who_stands_has_the_requested_number_of_equal_frames(representation):
    still = standing(representation, 7)
    assert still.features.shape == (7, representation.features)
    assert (still.fps, still.representation) == (representation.fps, representation.name)
    assert still.skeleton is representation.skeleton
    np.testing.assert_allclose(still.joints, still.joints[:1].repeat(7, 0), atol=1e-5)
    assert 1.2 < np.ptp(still.joints[0, :, 1]) < 1.7


@pytest.mark.golden
def test_bone_lengths_of_the_published_features_are_those_of_the_reference_clip():
    recipe = OmegaConf.load(ROOT / "experiments/representation/humanml_legacy.yaml")
    _, lengths = legacy("hml263")
    close(torch.tensor(list(recipe.bone_lengths)), lengths, 1e-7)


def test_the_adult_body_is_symmetric_and_does_not_change():
    adult = np.array(ADULT)
    np.testing.assert_array_equal(adult[list(SMPL24.mirrored)] * [-1, 1, 1], adult)
    np.testing.assert_allclose(adult.sum(0), [0, -1, 0], atol=1e-12)
    weighted = (np.arange(24) + 1) @ np.abs(adult)
    np.testing.assert_allclose(weighted, [33.391, 25.785, 8.775], atol=1e-9)


@pytest.mark.parametrize(
    ("representation", "columns"),
    [
        (HumanML(), [*range(4), *range(193, 196)]),
        (HumanML("kit21"), [*range(4), *range(184, 187)]),
        (Essential(), [*range(4)]),
        (Rot6D(), [*range(6), *range(144, 150)]),
        (SMPL(), [*range(9)]),
        (Motion272(), [*range(11), *range(74, 77), *range(140, 146)]),
    ],
    ids=lambda part: getattr(part, "name", ""),
)
def test_the_path_belongs_to_the_root(representation: Representation, columns: list[int]):
    assert representation.joint_features([0]).nonzero()[:, 0].tolist() == columns


@pytest.mark.parametrize(
    ("representation", "pose", "contacts"),
    [
        (HumanML(), (3, 193), [*range(259, 263)]),
        (HumanML("kit21", "legacy"), (3, 184), [*range(247, 251)]),
        (Essential(), (3, 67), None),
        (Rifke(), (0, 64), None),
        (SMPL(), (0, 147), None),
    ],
    ids=lambda part: getattr(part, "name", ""),
)
def test_poses_exclude_steps_velocities_and_contacts(representation, pose, contacts):
    assert (representation.pose.start, representation.pose.stop) == pose
    features = torch.arange(representation.features).repeat(2, 3, 1)
    columns = representation.contacts(features)
    assert (columns is None) == (contacts is None)
    if contacts is not None:
        assert columns.tolist() == [[contacts] * 3] * 2


@pytest.mark.parametrize("kind", [SMPL, Rot6D, Motion272])
def test_bones_have_the_lengths_of_the_given_offsets(kind: type[SMPL]):
    generator = torch.Generator().manual_seed(0)
    sizes = 0.5 + torch.rand(24, 1, generator=generator, dtype=torch.float64)
    offsets = torch.tensor(ADULT, dtype=torch.float64) * sizes
    offsets[0] = torch.tensor([0.1, -0.2, 0.3])
    representation = kind(offsets=offsets.tolist())
    raw = 0.4 * torch.randn(6, 75, generator=generator, dtype=torch.float64)
    features = representation.encode(raw).double()
    bones = representation.skeleton.bones(representation.decode(features)).norm(dim=-1)
    expected = offsets.norm(dim=-1)[: len(representation.skeleton)]
    close(bones[:, 1:], expected[1:].expand(6, -1), 1e-5)


def test_the_pelvis_of_smpl_is_beside_the_translation():
    offsets = [(0.1, -0.2, 0.3), *ADULT[1:]]
    raw = torch.zeros(1, 75)
    raw[0, :3] = torch.tensor([1.0, 2.0, 3.0])
    pelvis = SMPL(offsets=offsets).decode(SMPL().encode(raw))[0, 0]
    close(pelvis, torch.tensor([-1.1, 3.3, 1.8]), 1e-6)


@pytest.mark.parametrize("kind", [SMPL, Motion272])
@pytest.mark.parametrize("joints", [24, 52, 55])
def test_fingers_and_faces_of_raw_motions_do_not_change_the_features(kind, joints: int):
    generator = torch.Generator().manual_seed(0)
    raw = 0.3 * torch.randn(5, 3 + 3 * joints, generator=generator)
    assert torch.equal(kind().encode(raw), kind().encode(raw[:, :75]))


@pytest.mark.parametrize("kind", [SMPL, Rot6D])
def test_features_of_rotations_are_not_normalized(kind):
    mean, std = kind().statistics(torch.randn(50, kind().features))
    assert torch.equal(mean, torch.zeros(kind().features))
    assert torch.equal(std, torch.ones(kind().features))


@pytest.mark.parametrize("variant", ["clean", "legacy"])
@pytest.mark.parametrize(("units", "threshold"), [(1.0, 0.002), (640.0, 0.05)])
@pytest.mark.parametrize("foot", range(4))
def test_a_foot_has_contact_until_the_frame_before_it_moves(variant, units, threshold, foot: int):
    representation = HumanML(variant=variant, units_per_metre=units, contact_threshold=threshold)
    still = torch.from_numpy(posed(20).joints).double()
    for share, contact in ((0.99, 1), (1.01, 0)):
        joints = still.clone()
        joints[6:, SMPL22.feet[foot], 0] += share * math.sqrt(threshold) / units
        contacts = representation.contacts(representation.encode(joints))
        assert contacts is not None
        expected = torch.ones(19, 4)
        expected[5, foot] = contact
        assert torch.equal(contacts, expected)


@pytest.mark.parametrize(("frames", "factor", "count"), [(1, 8, 1), (2, 8, 9), (3, 4, 9)])
def test_frames_are_added_between_the_first_and_the_last(frames: int, factor: int, count: int):
    times = upsample(torch.arange(frames)[:, None].double(), factor)[:, 0]
    close(times, torch.arange(count) / factor, 1e-12)


@pytest.mark.parametrize(
    ("kind", "defaults"),
    [
        *(
            (
                kind,
                {
                    **{"skeleton": "smpl22", "variant": "clean", "fps": 20.0, "bone_lengths": None},
                    **{"units_per_metre": 1.0, "contact_threshold": 0.002},
                },
            )
            for kind in (HumanML, Essential)
        ),
        (Rifke, {"fps": 12.5, "units_per_metre": 640.0}),
        (Rot6D, {"fps": 20.0, "offsets": ADULT}),
        (SMPL, {"fps": 20.0, "offsets": ADULT}),
        (Motion272, {"fps": 30.0, "offsets": ADULT}),
    ],
)
def test_defaults_of_representations_do_not_change(kind, defaults):
    parameters = signature(kind).parameters.values()
    assert {p.name: p.default for p in parameters} == defaults


REPRESENTATIONS = [
    HumanML(),
    HumanML("kit21", "legacy", 12.5, units_per_metre=640.0),
    Essential(),
    Rifke(),
    Rot6D(),
    SMPL(),
    Motion272(),
]


@pytest.mark.parametrize("representation", REPRESENTATIONS, ids=lambda r: r.name)
def test_motions_of_a_batch_are_decoded_and_cut_as_each_one_alone(representation: Representation):
    """Features are random, so that every frame turns and moves."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 3, 7, representation.features, generator=generator).double()
    kept = features.clone()

    def check(convert: Callable[[Tensor], Tensor | None]) -> None:
        together = convert(features)
        assert together is not None
        for first, second in itertools.product(range(2), range(3)):
            alone = convert(features[first, second])
            assert alone is not None
            close(together[first, second], alone, 1e-9)

    check(representation.decode)
    check(representation.rotations6d)
    check(representation.rebase)
    if "contacts" in representation.slices:
        check(representation.contacts)
    if isinstance(representation, HumanML):
        check(lambda x: representation.root_steps(x)[0])
        check(lambda x: representation.root_steps(x)[1])
    if isinstance(representation, Motion272):
        check(lambda x: representation.poses(x)[0])
        check(lambda x: representation.poses(x)[1])
    assert torch.equal(features, kept), "features are not changed in place"


@pytest.mark.parametrize("representation", REPRESENTATIONS, ids=lambda r: r.name)
def test_the_first_of_several_bad_frames_is_named(representation: Representation):
    shape = (len(representation.skeleton), 3)
    if isinstance(representation, SMPL | Rot6D | Motion272):
        shape = (75,)
    motion = torch.zeros(9, *shape)
    motion[7], motion[4].flatten()[-1], motion[5] = math.nan, -math.inf, math.inf
    with pytest.raises(UserError, match=r"^motion: frame 4 contains NaN or infinite values"):
        representation.encode(motion)


def test_published_headings_are_smoothed_over_20_frames_at_any_rate():
    joints = torch.from_numpy(posed(80, heading=0.5 * np.sin(np.arange(80) / 12)).joints)
    expected = HumanML(variant="legacy").encode(joints)
    for fps in (12.5, 30.0, 60.0):
        assert torch.equal(HumanML(variant="legacy", fps=fps).encode(joints), expected)
        assert not torch.allclose(HumanML(fps=fps).encode(joints), HumanML().encode(joints))


def test_temos_keeps_every_deviation_but_zero_and_divides_by_one_frame_less():
    signs = torch.tensor([1.0, -1.0]).repeat(8)[:, None]
    features = signs * torch.tensor([0.0, 1e-6, 2.0])
    mean, std = Rifke().statistics(features)
    assert mean.tolist() == [0, 0, 0]
    unbiased = math.sqrt(16 / 15)
    torch.testing.assert_close(std, torch.tensor([1.0, 1e-6 * unbiased, 2 * unbiased]))


SMPL22_BONES = np.linalg.norm(ADULT[1:22], axis=-1).tolist()


def test_a_body_is_scaled_by_the_legs_of_its_own_first_frame():
    """Legs of two motions have different lengths; later frames do not change the scale."""
    usual = wander(frames=8)
    lengths = [0.0, *SMPL22_BONES]
    representation = HumanML(bone_lengths=lengths)
    tall, growing = 1.5 * usual, usual * torch.linspace(1, 2, 8)[:, None, None]
    together = representation.encode_many([usual, tall, growing])
    close(together[1], together[0], 1e-5)
    close(together[2][:, 3], representation.encode(growing)[:, 3], 1e-6)
    decoded = representation.decode(together[2])
    close(SMPL22.bones(decoded).norm(dim=-1), torch.tensor(lengths).expand(7, -1), 1e-5)
    root = growing[:-1, 0] - growing[:1, 0]
    scale = (lengths[5] + lengths[8]) / SMPL22.bones(growing[:1])[0, [5, 8]].norm(dim=-1).sum()
    moved = decoded[:, 0] - decoded[:1, 0]
    close(moved.norm(dim=-1), scale * root.norm(dim=-1), 1e-4)


@pytest.mark.parametrize("shape", [(22, 3), (4, 66), (4, 21, 3), (4, 22, 2), (1, 4, 22, 3)])
def test_motions_of_another_shape_are_refused_with_the_expected_one(shape: tuple[int, ...]):
    with pytest.raises(UserError, match=r"expected shape \(frames, 22, 3\) .*, but found \("):
        HumanML("smpl22").encode(torch.zeros(shape))
