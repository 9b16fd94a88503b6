import itertools
import math
import re

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
    load,
    meta,
    needs_third_party,
    third_party,
)
from torch import Tensor
from torch.nn import functional

from flame_mdm.config import check
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation, rotation
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272, face_forward
from flame_mdm.representations.rifke import Rifke, upsample
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import SKELETONS, SMPL22, SMPL24, forward_kinematics, global_rotations
from flame_mdm.representations.smpl import ADULT, SMPL

HUMANML_TOLERANCE = dict.fromkeys(["turn", "root_velocity", "root_height", "positions", "velocities"], 2e-5)
HUMANML_TOLERANCE |= {"rotations": 1e-4, "contacts": 0.0}
KIT_TOLERANCE = dict.fromkeys(["root_velocity", "root_height", "positions", "velocities"], 5e-3)
KIT_TOLERANCE |= {"turn": 1e-4, "rotations": 1e-4, "contacts": 0.0}
FIXTURES = {"hml263": golden, "kit251": golden}
FIXTURES |= {"third_party-hml263": third_party, "third_party-hml263_bandai": third_party}


def arrays(stem: str) -> Arrays:
    return FIXTURES[stem](stem.removeprefix("third_party-"))


def clips(stem: str, key: str) -> list[str]:
    """The clips of a fixture that have `key`."""
    return groups(arrays(stem), key)


def legacy(stem: str) -> tuple[HumanML, Tensor]:
    """The published features of a fixture, in its own units, and the bone lengths of its target skeleton."""
    lengths = torch.from_numpy(np.linalg.norm(arrays(stem)["tgt_offsets"], axis=-1))
    if stem.startswith("kit"):
        return HumanML("kit21", "legacy", fps=12.5, bone_lengths=lengths.tolist(), contact_threshold=0.05), lengths
    return HumanML("smpl22", "legacy", bone_lengths=lengths.tolist()), lengths


def decode_rotations(representation: HumanML, features: Tensor, bone_lengths: Tensor) -> Tensor:
    """Features (..., F, D) in the data's units -> joints (..., F, J, 3) in meters, from turn, root and rotations.

    `bone_lengths` (J,) are in meters, of the bone that ends in each joint.
    """
    heading, root = representation._root(features)
    skeleton, legacy = representation.skeleton, representation.legacy
    facing = torch.zeros_like(root)
    facing[..., 1] = -heading if legacy else heading
    local = features[..., representation.slices["rotations"]].unflatten(-1, (-1, 6))
    local = rotation.rot6d_to_matrix(local, "columns")
    local = torch.cat([rotation.axis_angle_to_matrix(facing)[..., None, :, :], local], -3)
    turned = global_rotations(local, skeleton.chain_parents if legacy else skeleton.parents)
    offsets = features.new_tensor(skeleton.raw_offsets) * bone_lengths[:, None]
    return skeleton.assemble((turned @ offsets[..., None])[..., 0], root / representation.units_per_metre)


def fixture(stem: str, clip: str, key: str) -> Tensor:
    return torch.from_numpy(arrays(stem)[f"{clip}/{key}"])


def close(actual: Tensor, expected: Tensor, atol: float) -> None:
    torch.testing.assert_close(actual.double(), expected.double(), atol=atol, rtol=0)


def yaw_quaternion(angle: Tensor) -> Tensor:
    zero = torch.zeros_like(angle)
    return torch.stack([torch.cos(angle / 2), zero, torch.sin(angle / 2), zero], -1)


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
    across = torch.stack([torch.sin(bend[:, 0, 1]), 0.2 * torch.sin(9 * time), torch.cos(bend[:, 0, 1])], -1)
    offsets = torch.tensor(body.raw_offsets, dtype=torch.float64) * size
    return forward_kinematics(body, rotation.axis_angle_to_matrix(bend), offsets, across)


@pytest.mark.golden
@pytest.mark.parametrize("stem", ["hml263", "kit251"])
def test_skeleton_constants_and_mirrored_joints(stem: str):
    skeleton = legacy(stem)[0].skeleton
    assert skeleton.parents == tuple(arrays(stem)["parents"])
    assert np.array_equal(skeleton.raw_offsets, arrays(stem)["raw_offsets"])
    if "kinematic_chain_padded" in arrays(stem):
        assert skeleton.chains == tuple(tuple(c[c >= 0].tolist()) for c in arrays(stem)["kinematic_chain_padded"])
    for clip in [clip for clip in clips(stem, "joints_in") if clip.endswith("_mirror")]:
        joints = fixture(stem, clip.removesuffix("_mirror"), "joints_in")
        assert torch.equal(SMPL22.mirror(joints), fixture(stem, clip, "joints_in"))


def test_skeletons_are_trees():
    for name, skeleton in SKELETONS.items():
        assert len(set(skeleton.joints)) == len(skeleton.parents) == len(skeleton.raw_offsets) == len(skeleton), name
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
@pytest.mark.parametrize(
    "stem", [pytest.param(stem, marks=[needs_third_party] if "third" in stem else []) for stem in FIXTURES]
)
def test_published_features_and_the_steps_to_and_from_them(stem: str):
    kit = stem.startswith("kit")
    (representation, lengths), atol = legacy(stem), 5e-3 if kit else 2e-5
    tolerances = KIT_TOLERANCE if kit else HUMANML_TOLERANCE
    for clip in clips(stem, "joints_in"):
        features, expected = representation.encode(fixture(stem, clip, "joints_in")), fixture(stem, clip, "feats")
        assert features.dtype == torch.float32
        assert features.shape == expected.shape == (len(expected), representation.features)
        for name, columns in representation.slices.items():
            close(features[:, columns], expected[:, columns], tolerances[name])

    for clip in clips(stem, "global_positions"):
        canonical = representation.canonicalize(fixture(stem, clip, "joints_in"))
        close(canonical, fixture(stem, clip, "global_positions"), atol)
    for clip in clips(stem, "uniform"):
        joints = fixture(stem, clip, "joints_in").double()
        one_clip = torch.zeros(len(joints), dtype=torch.int64)
        retargeted = representation._retarget(joints, torch.tensor([0]), one_clip)
        close(retargeted, fixture(stem, clip, "uniform"), atol)
    for clip in clips(stem, "ik_root"):
        expected = fixture(stem, clip, "ik_root")
        actual = yaw_quaternion(-representation._heading(fixture(stem, clip, "global_positions").double()))
        close(actual * (actual * expected).sum(-1, keepdim=True).sign(), expected, 1e-5)

    for clip in clips(stem, "rec_ric"):
        close(representation.decode(fixture(stem, clip, "feats")), fixture(stem, clip, "rec_ric"), atol)
    for clip in clips(stem, "root_quat"):
        heading, position = representation._root(fixture(stem, clip, "feats"))
        close(yaw_quaternion(-heading), fixture(stem, clip, "root_quat"), 1e-5)
        close(position, fixture(stem, clip, "root_pos"), atol)
    for clip in clips(stem, "rec_rot"):
        joints = decode_rotations(representation, fixture(stem, clip, "feats"), lengths)
        close(joints, fixture(stem, clip, "rec_rot"), atol)


@needs_third_party
@golden_case("third_party-hml263")
def test_published_statistics_and_normalization(stem: str):
    representation, _ = legacy(stem)
    features = fixture(stem, "official", "feats")
    portable = load(SHARED / "golden" / "portable" / "hml263.npz")
    clips = [portable[f"{clip}/feats"] for clip in groups(portable, "feats") if "mirror" not in clip]
    mean, std = representation.statistics(torch.from_numpy(np.concatenate([features.numpy(), *clips])))
    close(mean, fixture(stem, "stats_all", "mean"), 1e-5)  # the published one sums in float32
    close(std, fixture(stem, "stats_all", "std"), 1e-5)
    for prefix, key in (("", "normed"), ("eval_", "normed_eval")):
        representation.mean = torch.from_numpy(arrays(stem)[f"{prefix}mean"])
        representation.std = torch.from_numpy(arrays(stem)[f"{prefix}std"])
        close(representation.normalize(features), fixture(stem, "official", key), 2e-5)
        close(representation.denormalize(representation.normalize(features)), features, 1e-5)
        joints = representation.to_joints(representation.normalize(features))
        close(joints, fixture(stem, "official", "joints"), 2e-5)


def test_clean_motions_are_canonical_and_come_back():
    for skeleton, turns in itertools.product(SKELETONS, (-2.0, 0.0, 0.5, 2.0)):
        representation = HumanML(skeleton)
        joints = wander(skeleton, frames=120, turns=turns)
        features, canonical = representation.encode(joints), representation.canonicalize(joints)
        close(representation.decode(features), canonical[:-1], 1e-5)
        lengths = representation.skeleton.bones(canonical[0]).norm(dim=-1)
        close(decode_rotations(representation, features.double(), lengths), canonical[:-1], 1e-5)
        close(representation._root(features.double())[1], canonical[:-1, 0], 1e-5)

    for skeleton in SKELETONS:
        representation = HumanML(skeleton)
        joints = rotation.rotate_y(wander(skeleton), torch.tensor(2.0)) + torch.tensor([3.0, -1.0, 5.0])
        canonical = representation.canonicalize(joints)
        assert canonical[..., 1].min() == 0
        close(canonical[0, 0, ::2], torch.zeros(2), 1e-12)
        right_hip, left_hip, right_shoulder, left_shoulder = canonical[0, list(representation.skeleton.facing)]
        across = right_hip - left_hip + right_shoulder - left_shoulder
        assert across[2].item() == pytest.approx(0, abs=1e-9)
        assert across[0] < 0, "facing +z, the right side is at -x"
        close(representation.encode(wander(skeleton)), representation.encode(joints), 1e-5)


def test_opposite_bones():
    """A thigh straight up is opposite to its rest direction."""
    representation = HumanML()
    for tilt in (0.0, 1e-9, 1e-4):
        joints = wander(turns=0)
        joints = rotation.rotate_y(joints, -torch.atan2(*representation._facing(joints).unbind(-1))[:, None])
        lengths = representation.skeleton.bones(joints[0]).norm(dim=-1)
        offset = joints[:, 4] - joints[:, 1]
        joints[:, [4, 7, 10]] += torch.tensor([tilt, lengths[4].item(), 0]) - offset[:, None]
        features, canonical = representation.encode(joints), representation.canonicalize(joints)
        close(decode_rotations(representation, features.double(), lengths), canonical[:-1], 1e-5)
        assert HumanML(variant="legacy").encode(joints).isfinite().all()


def test_many_motions_at_once_are_encoded_as_one_by_one():
    motions = [wander(frames=frames, seed=frames, turns=frames / 30) for frames in (3, 41, 20)]
    for representation in (HumanML(bone_lengths=[0.2] * 22), HumanML(variant="legacy"), Essential()):
        for many, motion in zip(representation.encode_many(motions), motions, strict=True):
            assert torch.equal(many, representation.encode(motion))


def test_statistics():
    representation = HumanML()
    features = torch.randn(500, 263, generator=torch.Generator().manual_seed(0)) * torch.linspace(0.1, 3, 263)
    features[:, representation.slices["contacts"]] = 1.0
    features[:, representation.slices["root_height"]] = 0.9
    mean, std = representation.statistics(features)
    close(mean, features.mean(0), 1e-6)
    for name, columns in representation.slices.items():
        average = features[:, columns].std(0, unbiased=False).mean().item()
        expected = 1.0 if name in ("contacts", "root_height") else average
        close(std[columns], torch.full_like(std[columns], expected), 1e-6)


def test_bad_motions_and_options():
    bent, raw = torch.zeros(5, 22, 3), torch.zeros(4, 75)
    for representation, motion, message in (
        (HumanML(), bent[:2], "2 frames"),
        (HumanML(), bent[:, :21], r"\(5, 21, 3\).*\(frames, 22, 3\)"),
        (HumanML(), bent.index_fill(0, torch.tensor([3]), math.inf), "numbers in frame 3 are not finite"),
        (SMPL(), raw[:, :69], r"\(4, 69\)"),
        (Rot6D(), raw[:0], r"\(0, 75\)"),
        (Motion272(), raw[:1], "1 frame, but encoding needs at least 2"),
        (Rifke(), bent, r"shape \(5, 22, 3\), but rifke takes \(frames, 21, 3\)"),
    ):
        with pytest.raises(UserError, match=message):
            representation.encode(motion)
        if isinstance(representation, HumanML):
            with pytest.raises(UserError, match=f"motion 1: .*{message}"):
                representation.encode_many([wander(), motion])
    with pytest.raises(UserError, match="bone_lengths: 2 numbers for the 22 joints"):
        HumanML(bone_lengths=[1.0, 2.0])
    with pytest.raises(UserError, match=r"smpl23.*smpl22"):
        HumanML("smpl23")
    with pytest.raises(UserError, match="must be one of clean, legacy"):
        check({"_target_": "flame_mdm.representations.humanml.HumanML", "variant": "old"})


@golden_case("smpl147")
def test_flame_features_of_smplh_poses(stem: str):
    poses, translation = (torch.from_numpy(golden(stem)[f"prep/{key}"]) for key in ("poses156", "trans"))
    features = SMPL().encode(torch.cat([translation, poses], 1))
    assert features.dtype == torch.float32
    close(features, torch.from_numpy(golden(stem)["prep/feats147"]), 2e-6)


@needs_third_party
@golden_case("smpl147")
def test_flame_features_of_published_samples(stem: str):
    file = {key: torch.from_numpy(value) for key, value in third_party(stem).items() if value.dtype.kind == "f"}
    for clip in groups(third_party(stem), "feats147"):
        features = SMPL().encode(torch.cat([file[f"{clip}/translation"], file[f"{clip}/axis_angle"].flatten(1)], 1))
        close(features, file[f"{clip}/feats147"], 4e-4)  # as stored by their authors


@golden_case("smpl147")
def test_action_features_of_consecutive_skipped_and_all_frames(stem: str):
    file = {key: torch.from_numpy(value) for key, value in golden(stem).items() if key.startswith("a2m/")}
    cases = [re.fullmatch(r"a2m/(|rc_|full_)inp_(\w+)", key) for key in file]
    for kind, number in [case.groups() for case in cases if case]:
        motion = torch.cat([file[f"a2m/joints3d_{number}"][:, 0], file[f"a2m/pose72_{number}"]], 1)
        expected = file[f"a2m/{kind}inp_{number}"].permute(2, 0, 1).flatten(1)  # (25, 6, F) -> (F, 150)
        if kind == "":
            start = max(int(file[f"a2m/shift_draw_{number}"][2]), 0)
            motion = motion[(start + torch.arange(len(expected))).clamp(max=len(motion) - 1)]
        elif kind == "rc_":
            step, start = (int(draw[2]) for draw in file[f"a2m/rc_draws_{number}"])
            motion = motion[start::step][: len(expected)]
        close(Rot6D().encode(motion), expected, 2e-6)


@pytest.mark.parametrize("representation", [SMPL(), Rot6D()], ids=lambda r: r.name)
def test_smpl_bodies_stand_upright(representation: SMPL | Rot6D):
    motion = torch.zeros(2, 75)
    motion[:, 3] = {"smpl147": math.pi / 2, "rot6d-25": math.pi}[representation.name]
    motion[1, 3 + 3 * 18 + 2] = math.pi / 2  # bends the left elbow
    joints = representation.decode(representation.encode(motion))
    at = dict(zip(SMPL24.joints, joints[0].tolist(), strict=True))
    assert at["head"][1] > at["neck"][1] > at["pelvis"][1] > at["left_knee"][1] > at["left_foot"][1]
    assert 1.4 < at["head"][1] - at["left_foot"][1] < 1.7
    facing = torch.linalg.cross(joints[0, 1] - joints[0, 2], joints[0, 12] - joints[0, 0])
    assert (facing * (joints[0, 10] - joints[0, 7])).sum() > 0, "mirrored: toes point backwards"
    lengths = torch.tensor(ADULT).norm(dim=-1)
    close(SMPL24.bones(joints).norm(dim=-1)[:, 1:], lengths[1:].expand(2, -1), 1e-6)
    moved = (joints[1] - joints[0]).norm(dim=-1) > 1e-3
    assert [name for name, m in zip(SMPL24.joints, moved.tolist(), strict=True) if m] == ["left_wrist", "left_hand"]


def test_every_recipe_builds_decodes_and_passes_gradients():
    for path in sorted(ROOT.glob("experiments/representation/*.yaml")):
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
        owners = torch.stack([representation.joint_features([joint]) for joint in range(joints)])
        assert owners.shape == (joints, size)
        assert (owners.sum(0) >= 1).all()


def in_kit_units(key: str) -> Tensor:
    return torch.from_numpy(golden("temos64")[key])


@golden_case("temos64")
def test_features_floor_heading_and_joints_are_temos(stem: str):
    rifke, atol = Rifke(), 2e-3  # in KIT's unit, about 1.6 mm
    clips = {name: in_kit_units(f"{name}/joints_in").double() / 640 for name in groups(golden(stem), "joints_in")}
    for name, joints in clips.items():
        close(rifke.encode(joints), in_kit_units(f"{name}/feats"), atol)
        close(rifke.floor(joints * 640)[None], in_kit_units(f"{name}/floor"), atol)
        heading = rifke.heading(joints * 640)
        close(torch.stack([heading.sin(), heading.cos()], 1), in_kit_units(f"{name}/forward_used"), 1e-5)
        # the soft floor depends on the unit
        meters = Rifke(units_per_metre=1.0).encode(joints * 0.64)
        close(meters, in_kit_units(f"{name}/feats_metres_input"), 1e-5)
        close(rifke.decode(in_kit_units(f"{name}/feats").double()) * 640, in_kit_units(f"{name}/joints_back"), atol)
    close(rifke.decode(in_kit_units("gen/feats").double()) * 640, in_kit_units("gen/joints_back"), atol)
    close(upsample(in_kit_units("upsample/in").double()), in_kit_units("upsample/out_12.5_to_100"), 1e-9)
    # padding enters the floor of a batch in TEMOS
    features = in_kit_units("batch/feats_padded")
    for row, length in enumerate(in_kit_units("batch/lengths").tolist()):
        same = [clip for clip in clips.values() if len(clip) == length]
        padded = [functional.pad(clip, (0, 0, 0, 0, 0, features.shape[1] - length)) for clip in same]
        assert min((rifke.encode(p)[:length] - features[row, :length]).abs().max() for p in padded) < atol
    close(rifke.decode(features.double()) * 640, in_kit_units("batch/joints_back_padded"), atol)
    x = in_kit_units("norm/feats_clip0")
    rifke.mean.copy_(in_kit_units("norm/mean"))
    rifke.std.copy_(in_kit_units("norm/std"))
    ours = rifke.normalize(rifke.encode(next(iter(clips.values()))))
    close(ours * rifke.std, x * rifke.std, 2e-3)
    close(rifke.to_joints(x) * 640, in_kit_units("norm/joints_back_clip0"), 5e-3)


@golden_case("motion272")
def test_motion272_is_the_authors(stem: str):
    representation, file = Motion272(), golden(stem)

    def array(name: str) -> Tensor:
        return torch.from_numpy(file[name]).double()

    def pose(name: str) -> tuple[Tensor, Tensor]:
        """Translation and rotation matrices of an array of 22 axis-angles, 6 zeros and a translation."""
        values = array(name)
        return values[:, 72:75], rotation.axis_angle_to_matrix(values[:, :66].unflatten(1, (22, 3)))

    def cases(suffix: str) -> list[str]:
        return [name.partition("/")[2] for name in groups(file, suffix) if not name.startswith("f64/")]

    for case in cases("face_z"):
        translation, rotations = face_forward(*pose(f"in/{case}/smpl_85"))
        theirs, turned = pose(f"out/{case}/face_z")
        close(translation, theirs, 5e-6)
        close(rotations, turned, 1e-5)
        features = representation.features_of(array(f"in/{case}/joints"), turned)
        close(features, array(f"out/{case}/feats"), 2e-6)
    for case in cases("rec_positions"):
        features = array(f"{'in' if f'in/{case}/feats' in file else 'out'}/{case}/feats")
        close(representation.decode(features), array(f"out/{case}/rec_positions"), 5e-6)
        pelvis, rotations = representation.poses(features)
        theirs, turned = pose(f"f64/{case}/rec_smpl_85")
        close(pelvis, theirs, 1e-5)
        close(rotations, turned, 1e-5)
    frames = torch.cat([array(f"out/{case}/feats") for case in meta(file)["config"]["stats_over"]])
    for ours, name in zip(representation.statistics(frames.float()), ("mean", "std"), strict=True):
        close(ours, array(f"out/stats/{name}"), 1e-6)


@golden_case("essential67")
def test_essential_features_are_the_first_of_humanml_and_the_authors(stem: str):
    file = {key: torch.from_numpy(value) for key, value in golden(stem).items() if value.dtype.kind in "fi"}
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
    turns = 0.4 * torch.randn(24, 3, generator=torch.Generator().manual_seed(0)) * torch.sin(6 * time)[:, None, None]
    turns[:, 0] = torch.stack([torch.pi / 2 + 0 * time, 5 * time, 0 * time], 1)
    way = torch.stack([3 * torch.sin(5 * time), 3 * torch.cos(5 * time), 1 + 0.1 * torch.sin(20 * time)], 1)
    representation = Motion272()
    features = representation.encode(torch.cat([way, turns.flatten(1)], 1))
    cut = representation.rebase(features[20:])
    close(cut[1:], features[21:], 0)
    assert not cut[0, :2].any()
    joints, whole = representation.decode(cut.double()), representation.decode(features.double())[20:]
    assert joints[0, 0, [0, 2]].abs().max() == 0
    distances, expected = (torch.cdist(points, points) for points in (joints.flatten(0, 1), whole.flatten(0, 1)))
    close(distances, expected, 1e-4)
