"""The extension of Blender, built by tools/blender.py and used in Blender without a window."""

import json
import os
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fixtures import ROOT, blender, script
from support.glb import Glb
from support.motions import synthetic

import flame_mdm
from flame_mdm.errors import UserError
from flame_mdm.formats import characters
from flame_mdm.formats.characters import known_skeletons

pytestmark = [pytest.mark.tools, pytest.mark.slow, pytest.mark.timeout(900)]
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
    """What tests/support/blender_extension.py finds: names and joints (F, J, 3) of each motion, or an error."""
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


def test_an_unknown_platform_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"PLATFORM=linux-x86: unknown\. Did you mean linux-x64"):
        script("tools/blender.py").build("package", tmp_path / "x.zip", "linux-x86")
    assert list(tmp_path.iterdir()) == []
    assert any("thighl" in names and "spine006" in names for names in known_skeletons())
