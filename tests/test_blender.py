"""The extension of Blender, built by tools/blender.py and used in Blender without a window."""

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.fixtures import ROOT, blender, script
from support.glb import Glb
from support.motions import synthetic

import flame_mdm
from flame_mdm.checkpoints import runner
from flame_mdm.conditions.language import reading
from flame_mdm.errors import UserError
from flame_mdm.formats import characters, posture, rig
from flame_mdm.formats.characters import known_skeletons
from flame_mdm.representations import skeleton
from flame_mdm.sampling.motion_request import USUAL_SECONDS


def in_blender(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test that needs Blender."""
    return pytest.mark.tools(pytest.mark.slow(pytest.mark.timeout(900)(test)))


WALK = {
    "sentence": "a person walks forward",
    "seconds": 2.2,
    "seed": 1,
    "in_place": False,
    "onto_selected": False,
}
KICK = {
    "sentence": "someone's left leg delivers 2 kicks",
    "seconds": 0,
    "seed": 0,
    "onto_selected": False,
}
WAVE = {
    "sentence": "a person waves with both hands",
    "seconds": 3,
    "seed": 2,
    "in_place": False,
    "onto_selected": True,
}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    blender()
    tool = script("tools/blender.py")
    path = tmp_path_factory.mktemp("blender") / "flame_mdm.zip"
    tool.build("package", path, tool.this_machine())
    return path


def run(package: Path, requests: list[Any], folder: Path) -> list[Any]:
    """Name and joints (F, J, 3) of each motion in tests/support/blender_extension.py, or an error."""
    (folder / "requests.json").write_text(json.dumps(requests))
    command = [
        blender(),
        ROOT / "tests/support/blender_extension.py",
        package,
        folder / "requests.json",
        folder,
    ]
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / "blender"), "PYTHONPATH": ""}
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((folder / "results.json").read_text())


@in_blender
def test_blender_shows_the_motions_of_the_package(package: Path, tmp_path: Path, subtests) -> None:
    assert package.stat().st_size <= 40e6
    hero = tmp_path / "hero.glb"
    synthetic("kick").save(hero, rig="mixamo")
    model = flame_mdm.load("package")
    walk, kick, wave = (
        flame_mdm.generate(model, r["sentence"], seconds=r["seconds"] or None, seed=r["seed"])[0]
        for r in (WALK, KICK, WAVE)
    )
    requests = [[WALK, 20, None], [KICK | {"in_place": True}, 30, None], [WAVE, 20, str(hero)]]
    first, second, third = run(package, requests, tmp_path)
    for (names, joints), motion in ((first, walk), (second, kick)):
        with subtests.test(text=motion.text):
            order = [names.index(name) for name in motion.skeleton.joints]
            if motion is kick:  # 30 frames per second
                assert len(joints) == round((len(motion.joints) - 1) * 1.5) + 1
                joints = joints[::3]
                motion.joints[..., [0, 2]] -= motion.joints[:, :1, [0, 2]]
                motion.joints = motion.joints[::2]
            assert np.abs(np.array(joints)[:, order] - motion.joints).max() < 1e-3
    wave.save(tmp_path / "python.glb", character=hero)
    file, character = Glb(tmp_path / "python.glb"), characters.read_skinned(hero)
    names, joints = third
    for number in character.map.values():
        with subtests.test(joint=character.rig.joints[number]):
            expected = file.worlds()[:, character.file.nodes[number], :3, 3]
            actual = np.array(joints)[:, names.index(character.rig.joints[number])]
            assert np.abs(actual - expected).max() < 1e-3
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@in_blender
def test_what_cannot_be_generated_and_damage_are_refused_in_one_line(
    package: Path, tmp_path: Path, subtests
) -> None:
    requests = [WALK | {"sentence": "qwer asdf"}, WALK | {"sentence": " "}, WALK | {"seconds": 9}]
    errors = run(
        package,
        [[request, 20, None] for request in [*requests, WALK | {"onto_selected": True}]],
        tmp_path,
    )
    # files of the model are read by the runner, which tests/test_onnx.py damages
    damaged, hero = tmp_path / "flame_mdm.zip", tmp_path / "hero.glb"
    with zipfile.ZipFile(package) as source, zipfile.ZipFile(damaged, "w") as target:
        for item in source.namelist():
            target.writestr(item, source.read(item)[: -9 if item == "skeletons.json" else None])
    synthetic("kick").save(hero, rig="mixamo")
    errors += run(damaged, [[WAVE, 20, str(hero)]], tmp_path)
    messages = (
        "no word says what happens",
        "sentence is empty",
        "give 0.1 to 3",
        "select an arm",
        "skeletons.json is damaged",
    )
    for error, message in zip(errors, messages, strict=True):
        with subtests.test(message=message):
            assert message in error
            assert "\n" not in error


@in_blender
def test_an_unknown_platform_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"PLATFORM=linux-x86: unknown\. Did you mean linux-x64"):
        script("tools/blender.py").build("package", tmp_path / "x.zip", "linux-x86")
    assert list(tmp_path.iterdir()) == []
    assert any("thighl" in names and "spine006" in names for names in known_skeletons())


class Turn:
    """A stand-in for Blender's Quaternion: an array (w, x, y, z)."""

    def __init__(self, values: Sequence[float] = (1, 0, 0, 0)):
        self.values = np.array(values, float)

    def slerp(self, other: "Turn", share: float) -> "Turn":
        rotations = Rotation.from_quat([self.values, other.values], scalar_first=True)
        return Turn(Slerp([0, 1], rotations)(share).as_quat(scalar_first=True))

    def make_compatible(self, other: "Turn") -> None:
        self.values *= -1 if self.values @ other.values < 0 else 1


class Turning:
    """A stand-in for Blender's Matrix."""

    def __init__(self, values: np.ndarray | None = None):
        self.values = np.eye(3) if values is None else values

    def to_quaternion(self) -> Turn:
        return Turn(Rotation.from_matrix(self.values).as_quat(scalar_first=True))


@pytest.fixture(scope="module")
def extension() -> Iterator[Any]:
    """The module of the extension, with stand-ins for the modules of Blender."""
    stubs: dict[str, Any] = {
        "bpy": SimpleNamespace(
            data=SimpleNamespace(actions=SimpleNamespace(new=lambda name: name))
        ),
        "bpy.props": SimpleNamespace(),
        "mathutils": SimpleNamespace(Matrix=Turning, Quaternion=Turn),
    }
    stubs["bpy"].types = SimpleNamespace(
        **{name: type(name, (), {}) for name in ("PropertyGroup", "Operator", "Panel")}
    )
    for name in ("Bool", "Float", "Int", "Pointer", "String"):
        setattr(stubs["bpy.props"], f"{name}Property", lambda **options: options)
    modules = {
        "posture": posture,
        "reading": reading,
        "rig": rig,
        "runner": runner,
        "skeleton": skeleton,
    }
    stubs |= {f"flame_mdm_extension.{name}": module for name, module in modules.items()}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in stubs.items():
            patch.setitem(sys.modules, name, module)
        folder = ROOT / "tools" / "blender"
        spec = spec_from_file_location(
            "flame_mdm_extension", folder / "__init__.py", submodule_search_locations=[str(folder)]
        )
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        patch.setitem(sys.modules, spec.name, module)
        spec.loader.exec_module(module)
        yield module


@pytest.mark.parametrize(("seconds", "counted", "longest", "length"), [
    (0, None, 60, None), (0, 1.5, 60, 1.5), (0, 9.0, 100, 3.0), (0, 9.0, 50, 2.5), (2.5, 9.0, 60, 2.5),
])  # fmt: skip
def test_a_motion_of_the_extension_is_as_long_as_chosen_or_as_its_repetitions_take(
    extension, monkeypatch, seconds, counted, longest, length
):
    requests: list[Any] = []
    turns = Rotation.from_euler("Y", [[30 * number] for number in range(5)], degrees=True)
    quaternions = np.tile([1.0, 0, 0, 0], (5, 22, 1))
    quaternions[:, 0] = -turns.as_quat(scalar_first=True)  # the same rotations
    joints = np.random.default_rng(0).random((5, 22, 3)).astype(np.float32)
    model = SimpleNamespace(
        content={"fps": 20, "max_frames": longest},
        generate=lambda *values, **keywords: requests.append((*values, keywords)),
        decode=lambda _: joints.copy(),
        rotations=lambda _: (np.zeros((22, 3)), quaternions),
    )
    read = SimpleNamespace(
        captions=["a person kicks"], texts=["kicks"], steps=counted and [1],
        seconds=lambda: [counted], warnings=lambda: ["a warning"], summary=lambda: "kicks",
    )  # fmt: skip
    monkeypatch.setattr(extension, "sampler", lambda: model)
    monkeypatch.setattr(extension, "reader", lambda: SimpleNamespace(read=lambda _: read))
    sampled = extension.sample("she kicks", seconds, 7, False)
    assert requests == [("a person kicks", length, 7, {"text": "she kicks"})]
    np.testing.assert_allclose(sampled.joints, joints)
    assert (sampled.fps, sampled.summary, sampled.warnings) == (20, "kicks", ["a warning"])
    np.testing.assert_allclose(sampled.world[:, 0], turns.as_matrix().reshape(5, 3, 3), atol=1e-9)

    read.captions, read.texts = ["a person kicks", "a person jumps"], ["kicks", "jumps"]
    still = extension.sample("she kicks, then jumps", seconds, 7, True)
    assert requests[1][3] == {"text": "kicks"}
    assert still.warnings == [
        "a warning",
        "several actions: only the first is sampled, 'a person kicks'",
    ]
    # In place, the hips stay above their first position, and the pose does not change
    np.testing.assert_allclose(still.joints[:, 0, [0, 2]], joints[[0] * 5, 0][:, [0, 2]], atol=1e-6)
    np.testing.assert_allclose(still.joints[..., 1], joints[..., 1])
    np.testing.assert_allclose(
        still.joints - still.joints[:, :1], joints - joints[:, :1], atol=1e-6
    )


@pytest.mark.parametrize(
    ("fps", "base", "count"), [(30, 1.0, 31), (24, 1.001, 25), (20, 1.0, 21), (12, 1.0, 13)]
)
def test_keyframes_of_the_extension_show_the_motion_at_the_rate_of_the_scene(
    extension, monkeypatch, fps: int, base: float, count: int
):
    """A body of two bones turns at a constant rate and moves ahead at one meter per second, for a second."""
    times, offset = np.arange(21) / 20, np.array([0.0, 0.5, 0.0])
    turns = Rotation.from_euler("y", 500 * times[:, None], degrees=True).as_matrix()
    joints = np.zeros((21, 22, 3))
    joints[..., 2] = times[:, None]
    joints[:, 1:] += offset
    world = np.tile(turns[:, None], (1, 22, 1, 1))
    two = rig.Rig(
        joints=("hips", "spine"), parents=(-1, 0), positions=np.array([[0, 1.0, 0], [0, 1.5, 0]]),
        turns=np.tile(np.eye(3), (2, 1, 1)), sources=(0, 1), neutral=np.zeros((2, 3, 3)), orders=("XYZ",) * 2,
    )  # fmt: skip
    size, keys = 2.0, []

    class Bone(SimpleNamespace):
        def keyframe_insert(self, path: str, frame: int, group: str) -> None:
            turn = self.rotation_quaternion.values
            value = turn.copy() if path == "rotation_quaternion" else np.array(self.location)
            keys.append((group, path, frame, value))

    bones = {name: Bone(name=name, children_recursive=[]) for name in two.joints}
    pose = SimpleNamespace(rig=two, map={})
    monkeypatch.setattr(extension, "read_armature", lambda _: (pose, size))
    before = SimpleNamespace(use_fake_user=False)
    data = SimpleNamespace(action=before)
    armature = SimpleNamespace(
        animation_data_create=lambda: data, pose=SimpleNamespace(bones=bones)
    )
    render = SimpleNamespace(fps=fps, fps_base=base)
    scene = SimpleNamespace(render=render, frame_start=5, frame_end=7)
    motion = extension.Sampled(joints, world, np.zeros((22, 3)), 20, "", [])
    made = extension.animate(SimpleNamespace(scene=scene), armature, "walk", motion, True)
    assert made == count
    assert (scene.frame_end, data.action, before.use_fake_user) == (5 + count - 1, "walk", True)
    shown = np.minimum(np.arange(count) * base / fps, 1)
    rotations = [row for row in keys if row[:2] == ("hips", "rotation_quaternion")]
    assert [frame for _, _, frame, _ in rotations] == list(range(5, 5 + count))
    angles = [Rotation.from_quat(q, scalar_first=True).as_rotvec()[1] for *_, q in rotations]
    np.testing.assert_allclose(np.unwrap(angles), np.radians(500 * shown), atol=1e-9)
    values = np.array([q for *_, q in rotations])
    assert ((values[1:] * values[:-1]).sum(1) > 0).all()  # no quaternion changes its sign
    places = [value for group, path, _, value in keys if (group, path) == ("hips", "location")]
    expected = np.stack([0 * shown, 0 * shown - 1, shown], 1) / size  # relative to the rest pose
    np.testing.assert_allclose(places, expected, atol=1e-9)
    children = [value for group, path, _, value in keys if (group, path) == ("spine", "location")]
    np.testing.assert_allclose(children, np.zeros((count, 3)), atol=1e-9)


def test_lengths_of_the_extension_are_those_of_python():
    assert runner.USUAL_SECONDS == USUAL_SECONDS
