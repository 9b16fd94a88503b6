import numpy as np
import pytest
import torch
from support.fixtures import golden, groups

from flame_mdm.representations.rifke import Rifke, upsample

ATOL = 2e-3  # in KIT's unit, about 1.6 mm
STEM = "temos64"
CLIPS = [pytest.param(name, id=f"{STEM}-{name}") for name in groups(golden(STEM), "joints_in")]
one = pytest.mark.parametrize("stem", [pytest.param(STEM, id=STEM)])


def fixture(key):
    return torch.from_numpy(golden(STEM)[key])


def joints_in(name):
    """The clip in metres."""
    return fixture(f"{name}/joints_in").double() / 640


def close(ours, wanted, atol=ATOL):
    np.testing.assert_allclose(ours.detach().numpy(), wanted.numpy(), rtol=0, atol=atol)


@pytest.mark.golden
@pytest.mark.parametrize("name", CLIPS)
def test_features_floor_and_heading_are_temos(name):
    rifke = Rifke()
    joints = joints_in(name) * 640
    close(rifke.encode(joints_in(name)), fixture(f"{name}/feats"))
    close(rifke.floor(joints)[None], fixture(f"{name}/floor"))
    heading = rifke.heading(joints)
    close(torch.stack([heading.sin(), heading.cos()], 1), fixture(f"{name}/forward_used"), 1e-5)
    # the soft floor depends on the unit
    metres = Rifke(units_per_metre=1.0).encode(joints / 1000)
    close(metres, fixture(f"{name}/feats_metres_input"), 1e-5)


@pytest.mark.golden
@pytest.mark.parametrize("name", CLIPS)
def test_joints_come_back_as_temos_gives_them(name):
    close(Rifke().decode(fixture(f"{name}/feats").double()) * 640, fixture(f"{name}/joints_back"))


@pytest.mark.golden
@one
def test_noisy_features_decode_as_temos_does(stem):
    close(Rifke().decode(fixture("gen/feats").double()) * 640, fixture("gen/joints_back"))


@pytest.mark.golden
@one
def test_padding_enters_the_floor_of_a_batch(stem):
    features, back = fixture("batch/feats_padded"), fixture("batch/joints_back_padded")
    clips = [joints_in(param.values[0]) for param in CLIPS]
    for row, length in enumerate(fixture("batch/lengths").tolist()):
        padded = [torch.nn.functional.pad(clip, (0, 0, 0, 0, 0, features.shape[1] - length)) for clip in clips]
        encoded = [Rifke().encode(p)[:length] for p, clip in zip(padded, clips, strict=True) if len(clip) == length]
        close(min((e - features[row, :length]).abs().max() for e in encoded), torch.tensor(0.0))
    close(Rifke().decode(features.double()) * 640, back)


@pytest.mark.golden
@one
def test_normalization_is_temos(stem):
    rifke = Rifke()
    rifke.mean.copy_(fixture("norm/mean"))
    rifke.std.copy_(fixture("norm/std"))
    x = fixture("norm/feats_clip0")
    ours = rifke.normalize(rifke.encode(joints_in(CLIPS[0].values[0])))
    close(ours * rifke.std, x * rifke.std)
    close(rifke.to_joints(x) * 640, fixture("norm/joints_back_clip0"), 5e-3)


@pytest.mark.golden
@one
def test_upsampling_is_temos(stem):
    close(upsample(fixture("upsample/in").double()), fixture("upsample/out_12.5_to_100"), 1e-9)


def walk(frames, facing, turn):
    """A rigid body whose knees, elbows, hips and shoulders all face one way."""
    body = np.random.default_rng(1).normal([0, 1, 0], 0.3, (21, 3))
    for left, right in ((11, 16), (5, 8), (12, 17), (6, 9)):
        body[left], body[right] = [-0.2, 1, 0.1], [0.2, 1, 0.1]
    body[0] = [0, 0.9, 0]
    angle = facing + turn * np.arange(frames)[:, None]
    x, y, z = np.moveaxis(np.broadcast_to(body, (frames, 21, 3)), -1, 0)
    turned = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, np.cos(angle) * z - np.sin(angle) * x], -1)
    turned[..., ::2] += 0.05 * np.arange(frames)[:, None, None] * np.array([np.sin(facing), np.cos(facing)])
    return torch.from_numpy(turned)


@pytest.mark.parametrize(("facing", "turn"), [(0.0, 0.0), (1.0, 0.02), (-3.0, 0.3), (3.1, -0.4)])
def test_what_is_encoded_comes_back_canonical(facing, turn):
    rifke = Rifke()
    joints = walk(50, facing, turn)
    back = rifke.decode(rifke.encode(joints).double())
    canonical = walk(50, 0.0, turn)
    canonical[..., 1] -= rifke.floor(joints * 640) / 640
    close(back, canonical, 1e-5)
    assert np.isclose(rifke.encode(joints)[1:, 61].numpy() % (2 * np.pi), turn % (2 * np.pi), atol=1e-5).all()


def test_full_turns_stay_in_the_features_as_published():
    turned = Rifke().encode(walk(50, 3.0, 0.1))[:, 61]
    assert float(turned.min()) < -6


def test_decoding_is_differentiable_and_takes_batches():
    rifke = Rifke()
    features = torch.stack([rifke.encode(walk(20, 0.1, 0.05)), rifke.encode(walk(20, 2.0, -0.1))]).requires_grad_()
    joints = rifke.decode(features)
    assert joints.shape == (2, 20, 21, 3)
    close(joints[1], rifke.decode(features[1].detach()), 1e-6)
    [gradient] = torch.autograd.grad(joints.square().sum(), features)
    assert gradient.isfinite().all()
    assert (gradient.abs().amax((0, 1)) > 0).all()


def test_features_that_do_not_vary_are_divided_by_one():
    features = torch.randn(100, 64, generator=torch.Generator().manual_seed(0))
    features[:, 3] = 2.0
    mean, std = Rifke().statistics(features)
    assert float(std[3]) == 1
    close(std[:3], features[:, :3].std(0), 1e-6)
    close(mean, features.mean(0), 1e-6)


def test_features_of_joints():
    mask = Rifke().joint_features([0, 2])
    assert mask.nonzero()[:, 0].tolist() == [0, 4, 5, 6, 61, 62, 63]


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        (torch.zeros(5, 22, 3), r"shape \(5, 22, 3\), but rifke takes \(frames, 21, 3\)"),
        (torch.zeros(0, 21, 3), r"shape \(0, 21, 3\)"),
        (torch.full((5, 21, 3), torch.nan), "coordinates in frame 0 are not finite"),
    ],
)
def test_unfit_motions_are_refused(motion, message):
    with pytest.raises(ValueError, match=message):
        Rifke().encode(motion)
