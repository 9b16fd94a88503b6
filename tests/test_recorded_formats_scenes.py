"""Scenes, characters, pages and images of motions, as recorded."""

import io
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.glb import Glb, changed, odd_character, packed, write_names
from support.motions import posed, sway
from support.outcomes import temporary_folder
from support.recorded import Case, bodies, cases_of, check, combinations, outcome, record
from support.recorded_files import motions, without_paths
from support.traits import nested_traits, text_traits, traits

from flame_mdm.formats import (
    animated,
    bvh,
    character_meshes,
    characters,
    fbx,
    fbx_scene,
    fbx_writer,
    glb,
    glb_animation,
    motion,
    people,
    retarget,
    scenes,
)
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import KIT21, SKELETONS
from flame_mdm.representations.smpl import ADULT
from flame_mdm.visualize import body, contact_sheet, player, render, write_gif
from flame_mdm.visualize.body import Figure, mannequin

NAME = "formats_scenes"
RIGS = (None, "mixamo", "unreal", "unity", "rigify", "lafan1", "soma", "cmu", "100style")


def glb_contents(path: Path) -> Any:
    file = Glb(path)
    document = dict(file.document)
    parts = [document.pop(name) for name in ("accessors", "bufferViews", "buffers")]
    return [
        nested_traits(document),
        [
            [
                accessor.get("type"),
                accessor["componentType"],
                accessor["count"],
                accessor.get("normalized"),
            ]
            for accessor in parts[0]
        ],
        [traits(file.array(number), 2) for number in range(len(parts[0]))],
        [view.get("target") for view in parts[1]],
    ]


def glb_files() -> Any:
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for number, (name, ending, root_motion) in enumerate(
            (
                (None, ".glb", False),
                ("unreal", ".glb", True),
                ("soma", ".glb", False),
                (None, ".vrma", False),
            )
        ):
            path = folder / f"{number}{ending}"
            motions()[number].save(path, rig=name, root_motion=root_motion)
            content = glb_contents(path)
            results[f"{name} {ending}"] = content if number in (1, 3) else content[2:]
            file = glb.read(path)
            results[f"{name} {ending} read"] = [
                file.names,
                file.parents,
                traits(file.worlds),
                traits(glb_animation.world_matrices_of(path)),
                glb_animation.animations(path),
                glb_animation.humanoid(file),
                [traits(skin.corners) for skin in file.skins],
                scenes.joint_names(scenes.read(path)),
                scenes.animations(path),
            ]
        changes: dict[str, Callable[[dict[str, Any]], Any]] = {
            "extension": lambda d: d.update(extensionsRequired=["KHR_materials_x", "EXT_meshopt"]),
            "version": lambda d: d["asset"].update(version="1.0"),
            "two parents": lambda d: d["nodes"][0].update(children=[1, 1]),
            "circle": lambda d: d["nodes"][1].update(children=[0]),
            "no child": lambda d: d["nodes"][2].update(children=[999]),
            "matrix": lambda d: d["nodes"][0].update(matrix=[1.0] * 15),
            "large": lambda d: d["nodes"][0].update(translation=[1e10, 0, 0]),
            "no rate": lambda d: d["asset"].pop("extras"),
            "rate": lambda d: d["asset"].update(extras={"fps": 5000}),
            "no animation": lambda d: d.pop("animations"),
            "sampler": lambda d: d["animations"][0]["channels"][0].update(sampler=999),
            "step": lambda d: d["animations"][0]["samplers"][3].update(interpolation="STEP"),
            "cubic": lambda d: d["animations"][0]["samplers"][0].update(
                interpolation="CUBICSPLINE"
            ),
            "path": lambda d: d["animations"][0]["channels"][0]["target"].update(path="weights"),
            "zero": lambda d: d["nodes"][4].update(rotation=[0, 0, 0, 0]),
            "scaled": lambda d: d["nodes"][4].update(scale=[1, 2, 3]),
            "names": lambda d: [node.pop("name") for node in d["nodes"][:3]],
            "skin": lambda d: d["skins"][0].update(joints=[0, 999]),
            "binds": lambda d: d["accessors"][d["skins"][0]["inverseBindMatrices"]].update(count=3),
            "type": lambda d: d["accessors"][0].update(type="VEC3"),
        }
        for name, change in changes.items():
            path = folder / f"{name}.glb"
            motions()[0].save(path)
            changed(path, change)
            nodes = outcome(glb_animation.read, path)
            results[name] = (
                without_paths(folder, nodes)
                if isinstance(nodes, str)
                else [nodes.fps, traits(nodes.positions), nodes.names[:4], nodes.animation]
            )
        for name, content in (
            ("magic", b"glTG"),
            ("short", b"glTF\2\0\0\0"),
            ("no json", packed(b"{")),
            ("kind", packed(b"{}").replace(b"JSON", b"JSOM")),
            ("empty", packed(b'{"asset":{"version":"2.0"}}')),
            ("binary", packed(b'{"asset":{"version":"2.0"}}', b"1234")[:-2]),
        ):
            (folder / name).write_bytes(content)
            refusal = without_paths(folder, str(outcome(glb.read, folder / name)))
            results[name] = refusal[:120].partition(" object at")[0]
    return results


def numbers_of_glb_files() -> Any:
    rng = np.random.default_rng(9)
    results: dict[str, Any] = {}
    data = rng.integers(0, 256, 200).astype("u1").tobytes()
    for chosen in combinations(
        4,
        40,
        componentType=(*glb.COMPONENTS, 1),
        kind=("SCALAR", "VEC3", "VEC4"),
        normalized=(False, True),
        byteStride=(0, 16, 3),
        byteOffset=(0, 4),
        count=(0, 3, 9),
    ):
        kind, stride = chosen.pop("kind"), chosen.pop("byteStride")
        if chosen["componentType"] == glb.FLOAT and chosen["count"]:
            continue
        document = {
            "accessors": [{"bufferView": 0, "type": kind, **chosen}],
            "bufferViews": [{"buffer": 0, "byteStride": stride, "byteOffset": 8}],
        }
        file = glb.Glb(document, data, (), (), (), np.zeros(0), np.zeros(0), ())
        results[str((kind, stride, chosen))] = nested_traits(outcome(glb.numbers, file, 0, kind))
    results["others"] = [outcome(glb.numbers, file, number, "VEC3") for number in (0, 7)]
    nodes = [
        glb._Node(translation=[1, 2, 3], rotation=[0.5, 0.1, 0.2, 0.9], scale=[1, 2, 0.5]),
        glb._Node(matrix=[*map(float, range(16))]),
    ]
    results["nodes"] = [node.local() for node in nodes]
    for shape, normalized in (((3, 3), False), ((5,), False), ((2, 4), True), ((2, 4, 4), False)):
        binary = glb.Binary(b"12345", ({},))
        kind = "u1" if normalized else "f4"
        number = binary.add(
            np.arange(np.prod(shape)).reshape(shape).astype(kind),
            5 if normalized else None,
            not normalized,
            normalized,
        )
        results[str(shape)] = [
            number,
            binary.views,
            binary.accessors,
            len(binary.data),
            nested_traits(bytes(binary.data)),
        ]
    return results


def tracks_of_animations() -> Any:
    rng = np.random.default_rng(10)
    results: dict[str, Any] = {}
    times = np.array([-0.5, 0.1, 0.25, 0.4, 0.7, 1.0, 1.2, 3.0])
    for interpolation in ("LINEAR", "STEP", "CUBICSPLINE"):
        for width in (3, 4):
            for keys in (1, 2, 5):
                values = rng.normal(size=(keys, width))
                values[-1] = values[0]
                if width == 4:
                    values /= np.linalg.norm(values, axis=1, keepdims=True)
                track = glb_animation.Track(
                    np.array([0.1, 0.4, 0.7, 1.0, 1.2])[:keys],
                    values,
                    interpolation,
                    rng.normal(size=(2, keys, width)),
                )
                results[f"{interpolation} {width} {keys}"] = traits(track.at(times))
    for flags in ((0x4, 0x8, 0x2), (0x2 | 0x100, 0x2, 0x8), (0x8, 0x102, 0x4)):
        curve = fbx_scene.Curve(
            np.array([0.1, 0.4, 1.0]), rng.normal(size=3), np.array(flags), rng.normal(size=(3, 2))
        )
        results[str(flags)] = curve.at(times).tolist() + curve.at(np.linspace(0.1, 1.0, 9)).tolist()
    results["one"] = fbx_scene.Curve(
        np.array([0.3]), np.ones(1), np.zeros(1, int), np.zeros((1, 2))
    ).at(times)
    listed = [("walk", 1), ("2", 2), ("run", 3)] + [
        (f"more {number}", number) for number in range(30)
    ]
    results["chosen"] = [
        outcome(animated.choose, listed[:count], name)
        for count in (0, 3, 33)
        for name in (None, "walk", "2", 3, "3", "0", 40, "wlak", "²")
    ]
    results["order"] = [
        outcome(animated.parents_first, parents)
        for parents in ((2, -1, 1, 0), (1, 0), (-1, 0, -1, 1))
    ]
    local = rng.normal(size=(2, 4, 4, 4))
    results["worlds"] = [
        traits(animated.world_matrices((-1, 0, 1, -1), local)),
        str(outcome(animated.world_matrices, (-1, 0), 1e5 * local[:, :2]))[:80],
    ]
    nodes = animated.AnimatedNodes(
        ("hip", "hip_end", "Toe Nub", "foot", "tip"), (-1, 0, -1, 2, 3), local[:, :1], 20, "", {}
    )
    results["names"] = [
        scenes.joint_names(nodes),
        scenes.joint_names(
            animated.AnimatedNodes(nodes.names, nodes.parents, local, 20, "", {"head": 2})
        ),
    ]
    return results


def record_traits(record: fbx.Record) -> Any:
    return [
        record.name,
        [
            nested_traits(value) if not isinstance(value, fbx.Int | fbx.Short) else int(value)
            for value in record.properties
        ],
        [record_traits(child) for child in record.children],
    ]


def fbx_files() -> Any:
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for number, (name, fps, root_motion) in enumerate(
            ((None, 30.0, False), ("unreal", 59.94, True), ("soma", 120.0, False))
        ):
            source = motions()[number + 2]
            path = folder / f"{number}.fbx"
            Motion(source.joints, fps, text=source.text).save(
                path, rig=name, root_motion=root_motion
            )
            root = fbx.read(path)
            parts = [
                record_traits(record)
                for record in root.children
                if record.name not in ("Objects", "Connections")
            ]
            objects, connections = (next(root.all(kind)) for kind in ("Objects", "Connections"))
            results[str(name)] = [
                parts if number == 1 else parts[2:5],
                [record_traits(record) for record in objects.children[:: 7 if number else 23]],
                traits([len(record.children) for record in objects.children]),
                [record.properties[-1] for record in connections.children][::29],
                traits(
                    [
                        record.properties[1] * 3 + record.properties[2]
                        if record.properties[0] == "OO"
                        else record.properties[1]
                        for record in connections.children
                        if isinstance(record.properties[2], int)
                    ]
                ),
            ]
            nodes = fbx_scene.read(path)
            results[f"{name} read"] = [
                nodes.names,
                nodes.parents,
                traits(nodes.positions),
                nodes.fps,
                nodes.unit,
                nodes.animation,
                fbx_scene.animations(path),
            ]
        contacts = np.random.default_rng(3).uniform(size=(24, 2)) > 0.5
        poses = motions()[4].posed()
        clip = motion.rigged(poses, "clip", 24, retarget.preset("unreal", poses), None, True).part(
            slice(2, 20), "part", contacts[2:20]
        )
        fbx_writer.write(folder / "c.fbx", clip)
        objects = next(fbx.read(folder / "c.fbx").all("Objects"))
        results["contacts"] = [record_traits(record) for record in objects.children[-8:]]
        motion.glb_writer.write(folder / "c.glb", clip, "a text")
        results["contacts of glb"] = glb_contents(folder / "c.glb")[0]
        content = (folder / "c.fbx").read_bytes()
        wrong = {
            "magic": b"x" + content,
            "ascii": b"; FBX 7.4.0\nFBXHeaderExtension",
            "old": content[:23] + struct.pack("<I", 6100) + content[27:],
            "cut": content[:900],
            "byte": content[:29] + b"\xff" + content[30:],
            "empty": b"",
        }
        for name, data in wrong.items():
            (folder / name).write_bytes(data)
            results[name] = without_paths(
                folder, str(outcome(fbx.read, folder / name)).partition("<flame")[0]
            )
    return results


def nested_fbx_records() -> Any:
    results: list[Any] = []
    with temporary_folder() as folder:
        for depth in (1, 31, 32, 33, 34):
            root = record_of_level = fbx.Record("")
            for number in range(depth):
                record_of_level = record_of_level.add(f"level {number}", fbx.Int(number))
            fbx.write(folder / "a.fbx", root)
            read = outcome(fbx.read, folder / "a.fbx")
            results.append(
                without_paths(folder, read) if isinstance(read, str) else record_traits(read)
            )
    return results


def characters_with_several_skins() -> Any:
    results: list[Any] = []
    joints = list(range(22))
    for skins in (
        [joints],
        [joints[:12], joints[9:]],
        [joints[:5], joints[5:]],
        [joints[:5], joints[9:], joints[3:12]],
    ):
        with temporary_folder() as folder:
            path = folder / "a.glb"
            motions()[0].save(path, rig="mixamo")

            def change(document: dict[str, Any], skins: list[list[int]] = skins) -> None:
                document["skins"] = [
                    {"joints": [document["skins"][0]["joints"][k] for k in chosen]}
                    for chosen in skins
                ]

            changed(path, change)
            results.append(without_paths(folder, message_or_map(path)))
    return results


def fbx_scenes() -> Any:
    """Scenes with pivots, orders, axes, units and rates."""
    rng = np.random.default_rng(11)
    results: dict[str, Any] = {}
    for number in range(12):
        root = fbx.Record("")
        settings = root.add("GlobalSettings").add("Properties70")
        axes = ((0, 1, 2), (0, 2, 1), (1, 2, 0), (0, 0, 1))[number % 4]
        values = {
            "CoordAxis": axes[0],
            "UpAxis": axes[1],
            "FrontAxis": axes[2],
            "FrontAxisSign": -1 if number % 4 == 1 else 1,
            "UnitScaleFactor": (1.0, 2.54, -1.0, 100.0)[number % 4],
            "TimeMode": (6, 14, 0, 8, 11, 99)[number % 6],
            "CustomFrameRate": (25.0, 12.5, 0.0)[number % 3],
        }
        for name, value in values.items():
            settings.add("P", name, "", "", "", value)
        definitions = (
            root.add("Definitions")
            .add("ObjectType", "Model")
            .add("PropertyTemplate")
            .add("Properties70")
        )
        definitions.add("P", "RotationOrder", "", "", "", number % 7)
        objects, connections = root.add("Objects"), root.add("Connections")
        for k, name in enumerate(("Root", "Arm")):
            properties = objects.add("Model", 10 + k, f"{name}\x00\x01Model", "").add(
                "Properties70"
            )
            for label in (
                "PreRotation",
                "PostRotation",
                "RotationPivot",
                "RotationOffset",
                "ScalingPivot",
                "ScalingOffset",
                "Lcl Translation",
                "Lcl Rotation",
                "Lcl Scaling",
            ):
                if rng.uniform() < 0.8:
                    properties.add(
                        "P",
                        label,
                        "",
                        "",
                        "",
                        *rng.uniform(0.5, 40 if "Rotation" in label else 2, 3).tolist(),
                    )
            properties.add("P", "RotationActive", "", "", "", (number + k) % 3 > 0)
        connections.add("C", "OO", 11, 10)
        objects.add("AnimationStack", 20, f"Take {number}\x00\x01AnimStack", "")
        objects.add("AnimationLayer", 21, "Layer\x00\x01AnimLayer", "")
        connections.add("C", "OO", 21, 20)
        for k, target in enumerate(
            ("Lcl Rotation", "Lcl Translation", "Lcl Scaling", "Visibility")
        ):
            objects.add("AnimationCurveNode", 30 + k, "R\x00\x01", "")
            connections.add("C", "OO", 30 + k, 21)
            connections.add("C", "OP", 30 + k, 10 + k % 2, target)
            curve = objects.add("AnimationCurve", 40 + k, "\x00\x01", "")
            curve.add("KeyTime", np.array([0, 9, 20 + k]) * fbx_scene.TICKS // 30)
            curve.add("KeyValueFloat", rng.uniform(0.5, 30, 3).astype("f4"))
            if k != 1:
                curve.add("KeyAttrFlags", np.array([0x8, 0x2 | 0x100 * (number % 2)]))
                curve.add("KeyAttrRefCount", np.array([2, 1] if number != 5 else [2, 2]))
                curve.add("KeyAttrDataFloat", rng.normal(0, 9, 8))
            connections.add("C", "OP", 40 + k, 30 + k, f"d|{'XYZ'[(k + number) % 3]}")
        if number == 7:
            objects.add("AnimationLayer", 22, "Layer 2", "")
            connections.add("C", "OO", 22, 20)
            connections.add("C", "OO", 30, 22)
        with temporary_folder() as folder:
            fbx.write(folder / "a.fbx", root)
            nodes = outcome(fbx_scene.read, folder / "a.fbx")
            results[str(number)] = (
                without_paths(folder, nodes)
                if isinstance(nodes, str)
                else [
                    nodes.names,
                    nodes.parents,
                    traits(nodes.positions),
                    nodes.fps,
                    nodes.unit,
                    nodes.animation,
                ]
            )
    values = [
        True,
        fbx.Short(-3),
        fbx.Int(70000),
        5,
        -(2**40),
        0.5,
        "text",
        b"bytes",
        np.arange(3.0),
        np.arange(40, dtype="i4"),
        np.arange(9),
        np.ones(2, "f4"),
    ]
    results["packed"] = [nested_traits(fbx._packed(value)[:5]) for value in values]
    results["euler"] = [
        fbx_scene.euler(order, np.array([10.0, 50, -70])).tolist() for order in fbx_scene.ORDERS
    ]
    return results


def usd_files() -> Any:
    pytest.importorskip("pxr")
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        poses = motions()[5].posed()
        contacts = np.random.default_rng(4).uniform(size=(24, 2)) > 0.4
        for number, name in enumerate((None, "soma")):
            skeleton = retarget.preset(name, poses)
            clip = motion.rigged(
                poses, "clip", 24, skeleton, motions()[5].try_fit()[0], number == 1
            )
            path = folder / f"{number}.usda"
            motion.usd.write(path, clip.part(slice(0, 5), "part", contacts[:5]))
            text = path.read_text()
            results[str(name)] = [
                text_traits(part) for part in (text[:3000], text[3000:-9000], text[-9000:])
            ]
        results["names"] = [motion.usd._name(name) for name in ("a b", "1x", "", "é.c", "ok")]
    return results


def message_or_map(path: Path) -> Any:
    character = outcome(characters.read, path)
    return character if isinstance(character, str) else [character.map, character.floor]


def moving_characters() -> Any:
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for number, turned in enumerate((True, False)):
            path = folder / f"odd{number}.glb"
            odd_character(path, posed(), turned)
            refusal = without_paths(folder, str(outcome(characters.read, path)))
            results[f"unknown {number}"] = refusal[-300:]
            write_names(path.with_suffix(".yaml"))
            character = characters.read_skinned(path)
            results[f"character {number}"] = [
                character.map,
                character.floor,
                traits(character.rig.positions),
                traits(character.rig.turns),
                traits(character.rig.scales),
                character.rig.sources,
            ]
            for ending in (".glb", ".fbx", ".bvh"):
                saved = folder / f"moved{number}{ending}"
                results[f"{number} {ending}"] = [
                    without_paths(
                        folder, outcome(motions()[number].save, saved, character=character)
                    )
                ]
                if ending == ".glb":
                    results[f"{number} {ending}"] += [
                        *glb_contents(saved)[2:3],
                        glb_contents(saved)[0]["nodes"],
                    ]
                elif ending == ".fbx":
                    results[f"{number} {ending}"] += [traits(fbx_scene.read(saved).positions)]
            clip = character_meshes.character_clip(character, motions()[2], "clip")
            skin = clip.skins[0]
            results[f"clip {number}"] = [
                clip.joints,
                traits(clip.offsets),
                traits(clip.turns),
                traits(clip.scales),
                skin.name,
                skin.palette,
                traits(skin.points),
                traits(skin.normals),
                traits(skin.weights),
                traits(skin.binds),
                traits(skin.bones),
                skin.ordered,
                traits(skin.uvs),
            ]
        for name, other in (
            ("a", {"left_knee": "nothing"}),
            ("b", {"left_nee": "x"}),
            ("c", {"left_knee": None}),
            ("d", {"neck": None, "left_foot": None}),
        ):
            write_names(path.with_suffix(".yaml"), **other)
            results[f"names {name}"] = without_paths(folder, message_or_map(path))
        for name in RIGS[1:5]:
            tree = folder / f"{name}.bvh"
            motions()[2].save(tree, rig=name)
            character = characters.read(tree)
            message = motions()[4].save(folder / "out.bvh", character=character)
            results[f"tree {name}"] = [
                without_paths(folder, message),
                traits(bvh.read(folder / "out.bvh").frames),
                character.floor,
                traits(character.rig.positions),
                outcome(motions()[4].save, "out.glb", character=character),
            ]
        text = tree.read_text()
        for change in (
            ("Zrotation", ""),
            ("CHANNELS 6 Xposition Yposition Zposition", "CHANNELS 3"),
            ("thigh", "leg"),
            ("OFFSET ", "OFFSET -"),
        ):
            tree.write_text(text.replace(*change))
            results[f"tree {change}"] = without_paths(folder, message_or_map(tree))
    return results


def pages_of_motions() -> Any:
    results: dict[str, Any] = {}
    wide = Motion(
        bodies()["walk, turned"][:12] + np.linspace(0, 70, 12)[:, None, None],
        25,
        text="w" * 300,
        id="w",
    )
    shown = [*motions()[:2], wide, sway(5, skeleton=KIT21, id="kit")]
    for number, source in enumerate(shown):
        for begin in (0, 3):
            results[f"{number} {begin}"] = nested_traits(player.packed_motion(source, begin))
    figure = Figure(sway(4).joints, 20, text="figure")
    page = player.player_page(
        [*shown[:2], figure],
        "A <title>",
        "<p>about</p>",
        2,
        ["a", "b", ""],
        ["", "x", ""],
        [[(0, 4, "kind", "d<")], [], []],
    )
    plain = player.player_page([figure], about="")
    for label, text in (("page", page), ("plain", plain)):
        start, end = text.index('[{"id"'), text.rindex("</script>")
        results[label] = [
            text_traits(text[start:end]),
            re.findall(r"<title>.*?</title>|<details><summary>.*?</details>", text),
            [
                text.count(word)
                for word in ("A &lt;title", "__TITLE__", "__DATA__", '"anchors":', '"joints":')
            ],
        ]
    results["skeletons"] = [
        [body.sides(skeleton), body.head(skeleton), body.radii(skeleton)]
        for skeleton in SKELETONS.values()
    ]
    results["targets"] = [str(outcome(body.target, "a/b", listed)) for listed in ([], [figure])]
    with temporary_folder() as folder:
        player.write_player(folder / "a.html", [figure], title="T", columns=3)
        written = (folder / "a.html").read_text()
        results["written"] = written == player.player_page([figure], "T", columns=3)
    return results


def frame_count(film: Any) -> int:
    return film.n_frames


def pixels(image: Any) -> list[float]:
    return traits(np.asarray(image.convert("RGB"), float) / 255, 6)


def images_of_motions() -> Any:
    rng = np.random.default_rng(13)
    results: dict[str, Any] = {}
    figures = [
        *motions()[:2],
        sway(7, 60, contacts=True),
        sway(
            9, 12.5, skeleton=KIT21, text="one two three four five six seven eight nine ten eleven"
        ),
    ]
    high = Motion(figures[0].joints + np.array([4.2, 1.5, -2.6]), 20)
    far = Motion(
        figures[1].joints + np.linspace(0, 9, 24)[:, None, None] * [1, 0, 0.4],
        20,
        contacts=figures[1].contacts,
    )
    for number, source in enumerate((*figures, high, far)):
        fitted = source.try_fit()[0]
        for frame, size in ((0, 64), (5, 90)):
            results[f"{number} {frame}"] = [
                pixels(render._figure(source, shape, frame, size)) for shape in (fitted, None)
            ]
        results[f"{number} lines"] = [
            render._lines(source, shape, width, 64)
            for width in (60, 200)
            for shape in (fitted, None)
        ]
    project = render._camera(np.array([0.3, 1.0, -0.2]), 200)
    points = rng.normal(0, 2, (9, 3))
    results["camera"] = project(points).tolist()
    results["shaded"] = render._shaded(
        points / np.linalg.norm(points, axis=1, keepdims=True), rng.uniform(0, 255, (9, 3))
    ).tolist()
    image = np.zeros((20, 26, 3), np.uint8)
    corners = rng.uniform(-8, 34, (12, 2))
    render._rasterize(
        image,
        corners,
        rng.uniform(1, 5, 12),
        rng.uniform(0, 255, (12, 3)),
        rng.integers(0, 12, (14, 3)),
    )
    results["rasterized"] = traits(image, 10)
    with temporary_folder() as folder:
        for count, size in ((1, 48), (2, 40), (4, 32)):
            path = folder / f"{count}.gif"
            shown = [
                Motion(figure.joints[:6], figure.fps, figure.skeleton, figure.text)
                for figure in figures[:count]
            ]
            write_gif(path, shown, size)
            with Image.open(path) as film:
                frames = []
                for frame in range(frame_count(film)):
                    film.seek(frame)
                    frames.append([film.info["duration"], pixels(film)[::3]])
                results[path.name] = [
                    frame_count(film),
                    film.size,
                    film.info.get("loop"),
                    frames[:: 1 + len(frames) // 8],
                ]
        contact_sheet(folder / "a.png", figures[1:], 3, 48)
        with Image.open(folder / "a.png") as sheet:
            results["sheet"] = [sheet.size, pixels(sheet)]
    results["thumbnails"] = [
        Image.open(io.BytesIO(render.thumbnail(figure, height))).size
        for figure, height in ((figures[0], 60), (figures[3], 50))
    ]
    results["palette"] = traits(render._palette().getpalette(), 12)
    return results


def parts_of_people() -> Any:
    rng = np.random.default_rng(12)
    heads = {
        f"{name}{side}": np.array([0, 1, 0]) + rng.normal(0, 0.3, 3)
        for name in (*people.HEADS.values(), "clavicle", "shoulder01")
        for side in (".L", ".R")
    }
    heads |= {"head": np.array([0, 1.6, 0.1]), "neck01": np.array([0, 1.5, 0.05])} | {
        f"spine0{k}": np.array([0.01, 1.45 - 0.08 * k, 0.02 * k * k]) for k in range(1, 6)
    }
    joints = people._joints(heads)
    points, weights = rng.normal(0, 0.4, (40, 3)), rng.uniform(size=(40, 22)) ** 6
    weights[:9, 15] = 40
    weights /= weights.sum(1, keepdims=True)
    clothes = people._clothes(points, weights)
    helped = people.with_helpers(points, weights.copy(), np.array(ADULT[:22]).cumsum(0) * 0.4)
    packed_body = people.packed(
        points * 0.5,
        rng.normal(size=(40, 3)),
        helped,
        clothes,
        rng.integers(0, 40, (9, 3)),
        joints,
        people._turns(joints),
    )
    words = (
        ["age=0.9"],
        ["gender=1", "height=0"],
        ["age=1.1"],
        ["age"],
        ["agee=0.2"],
        ["weight=x"],
        [],
    )
    return {
        "owners": [
            people._owner(bone)
            for bone in (
                "spine04",
                "eye.L",
                "finger2-1.R",
                "toe1.L",
                "root",
                "upperleg02.L",
                "clavicle.R",
                "wrist.L",
                "neck03",
            )
        ],
        "joints": joints.tolist(),
        "turns": traits(people._turns(joints), 22),
        "clothes": traits(clothes, 9),
        "helpers": traits(helped, 9),
        "packed": nested_traits(packed_body),
        "words": [outcome(people.shape_of, list(listed)) for listed in words],
        "hairline": traits(people.hairline(points), 9),
        "smooth": people.smooth(0.2, 0.7, np.linspace(0, 1, 9)).tolist(),
        "bodies": [
            str(outcome(lambda name: traits(people.load_body(name).points), name))
            for name in ("mannequin", "", "anny age=2", "missing.npz")
        ],
        "largest": [part.tolist() for part in body.largest_weights(rng.uniform(size=(3, 7)))],
        "mannequin": [
            traits(value) for value in vars(mannequin()).values() if isinstance(value, np.ndarray)
        ]
        + [mannequin().sole],
    }


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
