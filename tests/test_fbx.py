"""FBX files: the container, motions written and read back, and files that are damaged or made to do harm."""

import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.fixtures import SHARED, needs_third_party
from support.motions import synthetic
from support.refusals import bounded

from flame_mdm.errors import UserError
from flame_mdm.formats import fbx, fbx_scene, fbx_writer, glb_animation
from flame_mdm.formats.animated import AnimatedNodes
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.fbx import Int, Record, Short
from flame_mdm.formats.fbx_scene import CUBIC, Curve
from flame_mdm.formats.retarget import preset, presets
from flame_mdm.formats.rigged import Material, RiggedClip, Skin, rigged
from flame_mdm.visualize.body import MATERIALS

MILLIMETER = 1e-3
RIGS = [None, *presets()]
FILES = SHARED / "data" / "files"


def clip(rig: str | None, root_motion: bool = False) -> RiggedClip:
    """A kick on a rig, with the skin of the person."""
    motion = synthetic("kick")
    poses = motion.posed()
    return rigged(poses, "kick", motion.fps, preset(rig, poses), fit_body(motion), root_motion)


def distance(motion: AnimatedNodes, names: list[str], expected: np.ndarray) -> float:
    """The largest distance of named nodes from positions (F, N, 3), in meters."""
    nodes = [motion.names.index(name) for name in names]
    return float(np.abs(motion.positions[:, nodes] - expected).max())


@pytest.mark.parametrize("rig", RIGS)
def test_a_motion_on_each_rig_is_read_back(rig: str | None, tmp_path: Path):
    synthetic("kick").save(tmp_path / "kick.fbx", rig=rig)
    motion = fbx_scene.read(tmp_path / "kick.fbx")
    expected = clip(rig)
    positions, _ = expected.world()
    positions[..., 1] += expected.lift
    moving = [
        joint
        for joint, parent in enumerate(expected.parents)
        if parent >= 0 or joint in expected.moves
    ]
    names = [expected.joints[joint] for joint in moving]
    assert distance(motion, names, positions[:, moving]) < 0.01 * MILLIMETER
    assert (motion.fps, motion.animation) == (20, "a person kicks")
    # a root on the floor stays there
    if "root" in presets().get(rig or "", {}):
        root = motion.positions[:, motion.names.index(expected.joints[0])]
        assert np.abs(root).max() < 0.2 * MILLIMETER


def test_a_person_on_soles_is_lifted_in_the_world_also_below_a_turned_root():
    turned = Rotation.from_euler("xyz", [-90, 20, 0], degrees=True).as_matrix()
    start = clip("unreal", root_motion=True)
    rest, turns = start.rest.copy(), start.turns.copy()
    rest[start.root] = turned
    turns[:, start.root] = turns[:, start.root] @ turned
    below = replace(start, rest=rest, turns=turns)
    assert 0.01 < below.lift < 0.05
    offsets, moves = below.on_soles()
    hips = max(below.moves)
    before, after = below.world()[0], replace(below, offsets=offsets, moves=moves).world()[0]
    lifted = np.array([0, below.lift, 0])
    np.testing.assert_allclose(after[:, 1:], before[:, 1:] + lifted, atol=1e-9)
    np.testing.assert_array_equal(after[:, below.root], before[:, below.root])
    moved = rest[below.root] @ (offsets[hips] - below.offsets[hips])
    np.testing.assert_allclose(moved, lifted, atol=1e-12)


@pytest.mark.parametrize("fps", [20, 24, 25, 30, 60, 29.97, 12.5])
def test_the_frame_rate_is_stored(fps: float, tmp_path: Path):
    motion = synthetic("kick")
    motion.fps = fps
    motion.save(tmp_path / "kick.fbx")
    again = fbx_scene.read(tmp_path / "kick.fbx")
    assert again.fps == pytest.approx(fps)
    assert len(again.positions) == len(motion.joints)


def test_equal_motions_become_equal_files_and_a_clip_with_skin_is_small(tmp_path: Path):
    for name in ("a.fbx", "b.fbx"):
        synthetic("kick").save(tmp_path / name, rig="mixamo")
    content = (tmp_path / "a.fbx").read_bytes()
    assert content == (tmp_path / "b.fbx").read_bytes()
    assert len(content) < 400_000


@pytest.mark.parametrize("rig", ["unreal", "soma"])
def test_root_motion_follows_the_hips_on_the_floor_and_changes_no_other_position(rig: str):
    still, moving = clip(rig), clip(rig, root_motion=True)
    positions, _ = still.world()
    with_root, turns = moving.world()
    np.testing.assert_allclose(with_root[:, 1:], positions[:, 1:], atol=1e-9)
    hips = max(still.moves)
    np.testing.assert_allclose(with_root[:, 0, [0, 2]], positions[:, hips][:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(with_root[:, 0, 1], 0, atol=1e-9)
    # the root turns about the vertical only
    up = turns[:, 0] @ still.rest[0].T @ [0, 1, 0]
    np.testing.assert_allclose(up, np.tile([0, 1, 0], (len(up), 1)), atol=1e-9)


def test_root_motion_needs_a_root():
    with pytest.raises(UserError, match="no root on the floor"):
        clip("mixamo", root_motion=True)


def test_the_scene_has_what_single_programs_need(tmp_path: Path, subtests):
    """Each of these details is missing in files that one program reads without an error, but incompletely."""
    synthetic("kick").save(tmp_path / "kick.fbx", rig="unreal")
    root = fbx.read(tmp_path / "kick.fbx")
    objects = root.first("Objects")
    assert objects is not None
    # Autodesk's SDK drops meshes without this property
    for model in objects.all("Model"):
        with subtests.test(name=model.properties[1]):
            properties = model.first("Properties70")
            assert properties is not None
            names = [entry.properties[0] for entry in properties.all("P")]
            assert "DefaultAttributeIndex" in names
    # assimp finds no animation without a block in its stack and layer: 13 zero bytes before the end of the record
    content = (tmp_path / "kick.fbx").read_bytes()
    for name in (b"AnimationStack", b"AnimationLayer"):
        with subtests.test(name=name):
            start = content.index(bytes([len(name)]) + name) - 12
            (end,) = struct.unpack_from("<I", content, start)
            assert content[end - 13 : end] == bytes(13)
    # other readers fail on negative ids
    assert min(record.properties[0] for record in objects.children) > 0
    # Blender keeps a pelvis in place that begins where its root ends
    offsets = {}
    for model in objects.all("Model"):
        properties = model.first("Properties70")
        assert properties is not None
        moved = next(
            entry for entry in properties.all("P") if entry.properties[0] == "Lcl Translation"
        )
        offsets[model.properties[1].partition("\x00")[0]] = moved.properties[4:]
    assert offsets["root"] == [0, 0, pytest.approx(-0.01)]


def test_the_skin_is_bound_in_its_own_pose(tmp_path: Path):
    """In the bind pose, vertices moved by their bones are where the file has them."""
    synthetic("kick").save(tmp_path / "kick.fbx", rig="lafan1")
    objects = fbx.read(tmp_path / "kick.fbx").first("Objects")
    assert objects is not None
    geometry = objects.first("Geometry")
    assert geometry is not None
    points = geometry.value("Vertices").reshape(-1, 3)
    total = np.zeros(len(points))
    for cluster in objects.all("Deformer"):
        if cluster.properties[2] != "Cluster":
            continue
        link = cluster.value("TransformLink").reshape(4, 4).T
        transform = cluster.value("Transform").reshape(4, 4).T
        np.testing.assert_allclose(link @ transform, np.eye(4), atol=1e-9)
        total[cluster.value("Indexes")] += cluster.value("Weights")
    np.testing.assert_allclose(total, 1)
    materials = geometry.first("LayerElementMaterial")
    assert materials is not None
    assert set(materials.value("Materials")) == {0, 1, 2, 3, 4}
    assert len(list(objects.all("Material"))) == 5


@needs_third_party
@pytest.mark.parametrize(
    ("name", "animation", "key"),
    [
        ("mixamo_prerotation.fbx", None, "walk"),
        ("mixamo_not_tpose.fbx", "Scene", "walk"),
        ("mixamo_not_tpose.glb", "Walk", "walk"),
        ("mixamo_not_tpose.glb", "2", "wave"),
        ("mixamo_not_tpose.glb", "Turn", "turn"),
        ("minimal.vrma", None, "walk"),
    ],
)
def test_files_of_other_writers_give_the_right_positions(
    name: str, animation: str | None, key: str
):
    read = fbx_scene.read if name.endswith(".fbx") else glb_animation.read
    motion = read(FILES / name, animation)
    stem = "minimal_vrma" if name.endswith(".vrma") else "mixamo_not_tpose"
    with np.load(FILES / f"{stem}_expected.npz") as expected:
        names = [str(joint) for joint in expected["names"]]
        positions = expected[key][: len(motion.positions)]
    assert len(positions) == len(motion.positions)
    assert distance(motion, names, positions) < 0.01 * MILLIMETER


@needs_third_party
def test_the_animation_is_chosen_by_name_or_number():
    assert glb_animation.animations(FILES / "mixamo_not_tpose.glb") == ["Walk", "Wave", "Turn"]
    assert fbx_scene.animations(FILES / "mixamo_prerotation.fbx") == ["Walk"]
    with pytest.raises(
        UserError, match=r"animation=Wawe: .*Did you mean Wave.*1 Walk, 2 Wave, 3 Turn"
    ):
        glb_animation.read(FILES / "mixamo_not_tpose.glb", "Wawe")
    with pytest.raises(UserError, match=r"animation=4: no such animation"):
        glb_animation.read(FILES / "mixamo_not_tpose.glb", 4)


@needs_third_party
def test_the_bones_of_a_humanoid_are_read_from_the_file():
    motion = glb_animation.read(FILES / "minimal.vrma")
    assert motion.names[motion.humanoid["left_wrist"]] == "leftHand"
    assert len(motion.humanoid) == 22


def test_curves_are_interpolated_between_keys():
    times = np.array([0.0, 1.0, 3.0])
    values = np.array([0.0, 2.0, -2.0])
    zero = np.zeros((3, 2))
    moments = np.array([-1.0, 0.5, 1.0, 2.0, 4.0])
    linear = Curve(times, values, np.array([4, 4, 4]), zero)
    np.testing.assert_allclose(linear.at(moments), [0, 1, 2, 0, -2])
    held = Curve(times, values, np.array([2, 2, 2]), zero)
    np.testing.assert_allclose(held.at(moments), [0, 0, 2, 2, -2])
    held_next = Curve(times, values, np.array([0x102, 0x102, 2]), zero)
    np.testing.assert_allclose(held_next.at(moments), [0, 2, -2, -2, -2])
    # a cubic with the slopes of t^3 - 2 t^2 is this polynomial
    times = np.array([0.0, 1.0, 2.0])
    slope = 3 * times**2 - 4 * times
    slopes = np.stack([slope, np.roll(slope, -1)], 1)
    cubic = Curve(times, times**3 - 2 * times**2, np.full(3, CUBIC), slopes)
    moments = np.linspace(0, 2, 9)
    np.testing.assert_allclose(cubic.at(moments), moments**3 - 2 * moments**2, atol=1e-12)


def animated(tmp_path: Path, **properties: tuple[float, ...]) -> AnimatedNodes:
    """A scene with a bone below another one; the first one has the properties, the second is 1 unit above it."""
    root = Record("")
    settings = root.add("GlobalSettings").add("Properties70")
    settings.add("P", "UnitScaleFactor", "double", "Number", "", 100.0)
    objects, connections = root.add("Objects"), root.add("Connections")
    for number, name in ((1, "parent"), (2, "child")):
        model = objects.add("Model", number, f"{name}\x00\x01Model", "LimbNode").add("Properties70")
        if name == "parent":
            model.add("P", "RotationActive", "bool", "", "", Int(1))
            for key, values in properties.items():
                model.add("P", key, "", "", "A", *values)
        else:
            model.add("P", "Lcl Translation", "", "", "A", 0.0, 1.0, 0.0)
    objects.add("AnimationStack", 3, "take\x00\x01AnimStack", "")
    objects.add("AnimationLayer", 4, "layer\x00\x01AnimLayer", "")
    objects.add("AnimationCurveNode", 5, "T\x00\x01AnimCurveNode", "")
    curve = objects.add("AnimationCurve", 6, "\x00\x01AnimCurve", "")
    curve.add("KeyTime", np.array([0, fbx_scene.TICKS], "<i8"))
    curve.add("KeyValueFloat", np.array([0.0, 3.0], "<f4"))
    pairs = (
        (1, 0, None),
        (2, 1, None),
        (4, 3, None),
        (5, 4, None),
        (5, 2, "Lcl Translation"),
        (6, 5, "d|X"),
    )
    for child, parent, target in pairs:
        connections.add("C", "OP" if target else "OO", child, parent, *([target] if target else []))
    fbx.write(tmp_path / "scene.fbx", root)
    return fbx_scene.read(tmp_path / "scene.fbx")


def test_pivots_offsets_and_orders_of_rotation_follow_the_documented_formula(tmp_path: Path):
    """Each expected position of the child was computed by hand."""
    motion = animated(tmp_path)
    np.testing.assert_allclose(motion.positions[0], [[0, 0, 0], [0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(motion.positions[-1], [[0, 0, 0], [3, 1, 0]], atol=1e-6)
    assert motion.names == ("parent", "child")

    motion = animated(tmp_path, PreRotation=(90.0, 0.0, 0.0))  # y becomes z
    np.testing.assert_allclose(motion.positions[0, 1], [0, 0, 1], atol=1e-9)

    motion = animated(tmp_path, PostRotation=(90.0, 0.0, 0.0))  # y becomes -z
    np.testing.assert_allclose(motion.positions[0, 1], [0, 0, -1], atol=1e-9)

    # 90 degrees about x, then about y: y becomes z, then x
    motion = animated(tmp_path, **{"Lcl Rotation": (90.0, 90.0, 0.0)})
    np.testing.assert_allclose(motion.positions[0, 1], [1, 0, 0], atol=1e-9)

    # the order ZYX turns about y first, which leaves y, then about x
    motion = animated(tmp_path, RotationOrder=(5.0,), **{"Lcl Rotation": (90.0, 90.0, 0.0)})
    np.testing.assert_allclose(motion.positions[0, 1], [0, 0, 1], atol=1e-9)

    # half a turn about x around the pivot (0, 1, 0): the child is on the pivot and stays
    motion = animated(
        tmp_path, RotationPivot=(0.0, 1.0, 0.0), **{"Lcl Rotation": (180.0, 0.0, 0.0)}
    )
    np.testing.assert_allclose(motion.positions[0, 1], [0, 1, 0], atol=1e-9)

    # scaled by 2 around the pivot (0, 1, 0): the child stays as well
    motion = animated(tmp_path, ScalingPivot=(0.0, 1.0, 0.0), **{"Lcl Scaling": (2.0, 2.0, 2.0)})
    np.testing.assert_allclose(motion.positions[0, 1], [0, 1, 0], atol=1e-9)


@pytest.mark.parametrize("order", range(6))
def test_a_node_has_the_product_of_the_matrices_in_the_documentation(order: int, tmp_path: Path):
    random = np.random.default_rng(order)
    names = ("RotationOffset", "RotationPivot", "ScalingOffset", "ScalingPivot")
    moves = {name: random.normal(size=3) for name in names}
    turns = {name: random.uniform(-90, 90, 3) for name in ("PreRotation", "PostRotation")}
    angles, sizes = random.uniform(-90, 90, 3), random.uniform(0.5, 2, 3)
    animation = {"Lcl Rotation": angles, "Lcl Scaling": sizes}
    values = {name: tuple(map(float, row)) for name, row in (moves | turns | animation).items()}
    motion = animated(tmp_path, RotationOrder=(float(order),), **values)

    def move(vector: np.ndarray) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = vector
        return matrix

    def turn(axes: str, degrees: np.ndarray) -> np.ndarray:
        """The rotation about the first axis comes first."""
        matrix = np.eye(4)
        for axis in axes:
            rotation = Rotation.from_euler(axis, degrees["xyz".index(axis)], degrees=True)
            matrix[:3, :3] = rotation.as_matrix() @ matrix[:3, :3]
        return matrix

    # Autodesk, "FBX SDK Programmer's Guide", Computing transformation matrices
    axes = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")[order]
    offset, pivot, size_offset, size_pivot = moves.values()
    product = move(offset) @ move(pivot) @ turn("xyz", turns["PreRotation"]) @ turn(axes, angles)
    product = product @ np.linalg.inv(turn("xyz", turns["PostRotation"])) @ move(-pivot)
    product = product @ move(size_offset) @ move(size_pivot) @ np.diag([*sizes, 1])
    product = product @ move(-size_pivot)
    np.testing.assert_allclose(motion.positions[0, 0], product[:3, 3], atol=1e-9)
    np.testing.assert_allclose(motion.positions[0, 1], (product @ [0, 1, 0, 1])[:3], atol=1e-9)


@pytest.mark.parametrize("seconds", [-0.5, 2.0])
def test_a_take_begins_at_its_first_key(seconds: float, tmp_path: Path):
    motion = animated(tmp_path)
    root = fbx.read(tmp_path / "scene.fbx")
    objects = root.first("Objects")
    assert objects is not None
    (curve,) = objects.all("AnimationCurve")
    (times,) = (record for record in curve.children if record.name == "KeyTime")
    times.properties[0] = times.properties[0] + round(seconds * fbx_scene.TICKS)
    fbx.write(tmp_path / "scene.fbx", root)
    later = fbx_scene.read(tmp_path / "scene.fbx")
    np.testing.assert_allclose(later.positions, motion.positions, atol=1e-6)


@pytest.mark.parametrize(
    ("mode", "custom", "fps"),
    [(0, 12.5, 12.5), (14, 90.0, 90.0), (6, 12.5, 30), (11, 0.0, 24), (0, 0.0, 30), (0, 1e6, 30)],
)
def test_the_rate_of_an_fbx_file_is_that_of_its_mode_or_its_own(
    mode: int, custom: float, fps: float, tmp_path: Path
):
    animated(tmp_path)
    root = fbx.read(tmp_path / "scene.fbx")
    settings = root.first("GlobalSettings")
    block = settings.first("Properties70") if settings else None
    assert block is not None
    block.add("P", "TimeMode", "enum", "", "", Int(mode))
    block.add("P", "CustomFrameRate", "double", "Number", "", custom)
    fbx.write(tmp_path / "scene.fbx", root)
    motion = fbx_scene.read(tmp_path / "scene.fbx")
    assert (motion.fps, len(motion.positions)) == (fps, math.floor(fps) + 1)


def test_records_come_back_with_their_types(tmp_path: Path, subtests):
    root = Record("")
    values = [True, Short(-3), Int(7), 2**40, 0.5, "text", b"\x00raw"]
    record = root.add("Values", *values)
    arrays = [np.arange(100, dtype=kind) for kind in ("<f4", "<f8", "<i4", "<i8")]
    for array in arrays:
        record.add("Array", array)
    fbx.write(tmp_path / "values.fbx", root)
    (again,) = fbx.read(tmp_path / "values.fbx").children
    assert again.properties == values
    for array, child in zip(arrays, again.children, strict=True):
        with subtests.test(dtype=array.dtype):
            np.testing.assert_array_equal(child.properties[0], array)
            assert child.properties[0].dtype == array.dtype


def header(version: int = fbx.VERSION) -> bytes:
    return fbx.MAGIC + struct.pack("<I", version)


def wide_record(name: bytes, properties: bytes = b"", count: int = 0) -> bytes:
    """The bytes of a record without children in a file of version 7.5."""
    start = len(header())
    head = struct.pack(
        "<QQQB", start + 25 + len(name) + len(properties), count, len(properties), len(name)
    )
    return head + name + properties


def test_files_with_offsets_of_64_bits_are_read(tmp_path: Path):
    text = b"S" + struct.pack("<I", 2) + b"hi"
    (tmp_path / "wide.fbx").write_bytes(header(7700) + wide_record(b"Creator", text, 1) + bytes(25))
    assert fbx.read(tmp_path / "wide.fbx").value("Creator") == "hi"


def bomb() -> bytes:
    """An array that says it has few bytes, and expands to many."""
    packed = zlib.compress(bytes(10**7))
    array = b"d" + struct.pack("<III", 10, 1, len(packed)) + packed
    return header(7700) + wide_record(b"Vertices", array, 1) + bytes(25)


def claim(items: int, encoding: int = 1) -> bytes:
    array = b"d" + struct.pack("<III", items, encoding, 4) + b"\x78\x9c\x03\x00"
    return header(7700) + wide_record(b"Vertices", array, 1) + bytes(25)


def nested() -> bytes:
    """Records in one another, deeper than any program writes."""
    depth = 2000
    content = bytearray(header())
    end = len(content) + 14 * depth
    for _ in range(depth):
        content += struct.pack("<IIIB", end, 0, 0, 1) + b"A"
    return bytes(content)


REFUSED = {
    "empty": (b"", "not an FBX file"),
    "text": (b"hello", "not an FBX file"),
    "ascii": (
        b"; FBX 7.7.0 project file\nFBXHeaderExtension:  {\n",
        "this is an ASCII FBX file. Export it as binary FBX",
    ),
    "ascii without a header": (b"\n ; Kaydara FBX\nObjects:  {\n", "this is an ASCII FBX file"),
    "ascii without a comment": (b"FBXHeaderExtension:  {\n", "this is an ASCII FBX file"),
    "old": (header(6100), r"FBX version 6\.1, but only version 7"),
    "header alone": (header(), "damaged"),
    "endless name": (header() + struct.pack("<IIIB", 60, 0, 0, 255) + b"A" * 20, "ends outside"),
    "record that ends before it begins": (
        header() + struct.pack("<IIIB", 5, 0, 0, 0) + bytes(40),
        "ends outside",
    ),
    "record past the end": (
        header() + struct.pack("<IIIB", 10**6, 0, 0, 0) + bytes(40),
        "ends outside",
    ),
    "many properties": (
        header(7700) + wide_record(b"A", b"C\x01", 10**9),
        "properties do not fit into 2 bytes",
    ),
    "unknown property": (header(7700) + wide_record(b"A", b"Z\x01", 1), "unknown property"),
    "bomb": (bomb(), "an array has"),
    "large claim": (claim(2**31), "arrays take more than"),
    "short array": (claim(10), "an array has"),
    "unknown encoding": (claim(10, 9), "unknown encoding 9"),
    "nested": (nested(), "nesting levels"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_and_hostile_containers_are_refused(name: str, tmp_path: Path):
    content, message = REFUSED[name]
    (tmp_path / "x.fbx").write_bytes(content)
    with bounded(), pytest.raises(UserError, match=message) as raised:
        fbx_scene.read(tmp_path / "x.fbx")
    assert str(raised.value).startswith(str(tmp_path / "x.fbx"))
    assert "\n" not in str(raised.value)


def changed(tmp_path: Path, change: str) -> Path:
    """A valid file of a kick with one fault in its scene."""
    path = tmp_path / "kick.fbx"
    synthetic("kick").save(path)
    root = fbx.read(path)
    objects, connections = root.first("Objects"), root.first("Connections")
    assert objects is not None
    assert connections is not None
    models = [record.properties[0] for record in objects.all("Model")]
    curve = objects.first("AnimationCurve")
    layer = objects.first("AnimationLayer")
    assert curve is not None
    assert layer is not None
    if change == "cycle":
        connections.add("C", "OO", models[0], models[5])
    elif change == "no animation":
        objects.children = [
            record for record in objects.children if record.name != "AnimationStack"
        ]
    elif change == "two layers":
        objects.add("AnimationLayer", 5, "second\x00\x01AnimLayer", "")
        stack = objects.first("AnimationStack")
        assert stack is not None
        connections.add("C", "OO", 5, stack.properties[0])
        node = objects.first("AnimationCurveNode")
        assert node is not None
        connections.add("C", "OO", node.properties[0], 5)
    elif change == "keys out of order":
        curve.first("KeyTime").properties[0] = curve.value("KeyTime")[::-1]  # type: ignore[union-attr]
    elif change == "far keys":
        times = curve.value("KeyTime").copy()
        times[-1] = 2**62
        curve.first("KeyTime").properties[0] = times  # type: ignore[union-attr]
    elif change == "nan":
        values = curve.value("KeyValueFloat").copy()
        values[3] = np.nan
        curve.first("KeyValueFloat").properties[0] = values  # type: ignore[union-attr]
    elif change == "attributes":
        curve.first("KeyAttrRefCount").properties[0] = np.array([2**31 - 1], "<i4")  # type: ignore[union-attr]
    fbx.write(path, root)
    return path


FAULTS = {
    "cycle": "own ancestor",
    "no animation": "contains no animation",
    "two layers": "2 animation layers in a person kicks. Bake or merge",
    "keys out of order": "not in order",
    "far keys": "too many",
    "nan": "not in order, or not finite",
    "attributes": "do not match its keys",
}


@pytest.mark.parametrize("change", FAULTS)
def test_faults_of_the_scene_are_named(change: str, tmp_path: Path):
    path = changed(tmp_path, change)
    with bounded(), pytest.raises(UserError, match=FAULTS[change]) as raised:
        fbx_scene.read(path)
    assert "\n" not in str(raised.value)


def with_settings(tmp_path: Path, **values: float) -> AnimatedNodes:
    """The scene of `animated` with other numbers in its settings."""
    animated(tmp_path)
    root = fbx.read(tmp_path / "scene.fbx")
    settings = root.first("GlobalSettings")
    block = settings.first("Properties70") if settings else None
    assert block is not None
    for name, value in values.items():
        block.add("P", name, "double", "Number", "", float(value))
    fbx.write(tmp_path / "scene.fbx", root)
    return fbx_scene.read(tmp_path / "scene.fbx")


@pytest.mark.parametrize(
    ("settings", "start", "end"),
    [
        ({"UpAxis": 2, "FrontAxis": 1, "FrontAxisSign": -1}, (0, 0, -1), (3, 0, -1)),  # 3ds Max
        ({"UpAxis": 0, "CoordAxis": 1, "CoordAxisSign": -1}, (-1, 0, 0), (-1, 3, 0)),
        ({"UpAxisSign": -1, "CoordAxisSign": -1}, (0, -1, 0), (-3, -1, 0)),
        ({"FrontAxisSign": -1}, (0, 1, 0), (3, 1, 0)),  # not right-handed
        ({"UnitScaleFactor": 2.54}, (0, 0.0254, 0), (0.0762, 0.0254, 0)),
        ({"UnitScaleFactor": 0}, (0, 0.01, 0), (0.03, 0.01, 0)),
    ],
)
def test_a_scene_is_turned_to_y_up_and_z_forward_and_scaled_to_meters(
    settings: dict, start: tuple, end: tuple, tmp_path: Path
):
    motion = with_settings(tmp_path, **settings)
    np.testing.assert_allclose(motion.positions[[0, -1], 1], [start, end], atol=1e-6)
    unit = settings.get("UnitScaleFactor", 100) or 1
    assert motion.unit == pytest.approx(0.01 * unit)


def test_defaults_of_models_come_before_their_own_properties_and_rotations_may_be_inactive(
    tmp_path: Path,
):
    angles = {"Lcl Rotation": (90.0, 90.0, 0.0)}
    inactive = animated(
        tmp_path, RotationActive=(0.0,), RotationOrder=(5.0,), PreRotation=(9.0, 9.0, 9.0), **angles
    )
    np.testing.assert_allclose(inactive.positions[0, 1], [1, 0, 0], atol=1e-9)
    for values, expected in (({}, [0, 0, 1]), ({"PreRotation": (-90.0, 0.0, 0.0)}, [0, 0, -1])):
        animated(tmp_path, **values)
        root = fbx.read(tmp_path / "scene.fbx")
        definitions = root.add("Definitions")
        for kind, degrees in (("Geometry", 45.0), ("Model", 90.0)):
            template = definitions.add("ObjectType", kind).add("PropertyTemplate", "FbxNode")
            block = template.add("Properties70")
            block.add("P", "PreRotation", "Vector3D", "Vector", "", degrees, 0.0, 0.0)
        fbx.write(tmp_path / "scene.fbx", root)
        motion = fbx_scene.read(tmp_path / "scene.fbx")
        np.testing.assert_allclose(motion.positions[0, 1], expected, atol=1e-9)


def test_attributes_of_a_curve_apply_to_as_many_keys_as_they_say():
    record = Record("AnimationCurve")
    record.add("KeyTime", fbx_scene.TICKS * np.array([1, 2, 4], "<i8"))
    record.add("KeyValueFloat", np.array([0, 2, -2], "<f4"))
    record.add("KeyAttrFlags", np.array([CUBIC, 4], "<i4"))
    record.add("KeyAttrDataFloat", np.array([1, 2, 9, 9, 3, 4, 9, 9], "<f4"))
    record.add("KeyAttrRefCount", np.array([2, 1], "<i4"))
    curve = fbx_scene._curve(record)
    assert curve.times.tolist() == [1, 2, 4]
    assert curve.flags.tolist() == [CUBIC, CUBIC, 4]
    assert curve.slopes.tolist() == [[1, 2], [1, 2], [3, 4]]


@pytest.mark.parametrize("length", range(1, 18))
def test_the_end_of_a_file_is_aligned_to_16_bytes(length: int, tmp_path: Path):
    """As in files of Autodesk's SDK: 1 to 16 zeros, the version, 120 zeros and a constant."""
    root = Record("")
    root.add("A" * length)
    fbx.write(tmp_path / "a.fbx", root)
    content = (tmp_path / "a.fbx").read_bytes()
    start = content.index(fbx.FOOTER_ID)
    assert content[start - 13 : start] == bytes(13)  # the end of the list of records
    after = start + 16 + 4
    aligned = 16 * (after // 16 + 1)
    assert content[start + 16 : aligned] == bytes(aligned - start - 16)
    assert content[aligned : aligned + 4] == struct.pack("<I", 7400)
    assert content[aligned + 4 :] == bytes(120) + fbx.FOOTER_END


def test_arrays_and_records_of_a_file_are_limited_together(tmp_path: Path, monkeypatch):
    root = Record("")
    for _ in range(2):
        root.add("Parent").add("Array", np.arange(62, dtype="<f8"))
    fbx.write(tmp_path / "a.fbx", root)
    for name, limit, message in (
        ("EXPANDED_LIMIT", 992, "arrays take more than"),
        ("MAX_RECORDS", 4, "4 records|3 records"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(fbx, name, limit)
            assert len(fbx.read(tmp_path / "a.fbx").children) == 2
            patch.setattr(fbx, name, limit - 1)
            with pytest.raises(UserError, match=message):
                fbx.read(tmp_path / "a.fbx")


def test_a_mesh_has_its_triangles_normals_materials_and_texture_at_each_corner():
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 3.0]])
    skin = Skin(
        name="cloth",
        points=points,
        normals=points / 4,
        triangles=np.array([[0, 1, 2], [3, 0, 2]]),
        palette=(Material("red", (1, 0, 0)), Material("blue", (0, 0, 1))),
        materials=np.array([1, 0]),
        ordered=(0,),
        bones=np.zeros((4, 1), int),
        weights=np.ones((4, 1)),
        binds=np.eye(4)[None],
        uvs=points[:, :2] / 2,
    )
    record = Record("Geometry")
    fbx_writer._geometry(record, skin)
    np.testing.assert_array_equal(record.value("Vertices").reshape(-1, 3), 100 * points)
    assert record.value("PolygonVertexIndex").tolist() == [0, 1, ~2, 3, 0, ~2]
    layers = {name: record.first(f"LayerElement{name}") for name in ("Normal", "UV", "Material")}
    for name, values, width in (("Normal", "Normals", 3), ("UV", "UV", 2)):
        layer = layers[name]
        assert layer is not None
        assert layer.value("MappingInformationType") == "ByPolygonVertex"
        corners = layer.value(values).reshape(-1, width)[layer.value(f"{values}Index")]
        stored = skin.normals if name == "Normal" else skin.uvs
        np.testing.assert_array_equal(corners, stored[skin.triangles.ravel()])
    assert layers["Material"] is not None
    assert layers["Material"].value("Materials").tolist() == [1, 0]


def test_each_bone_moves_the_vertices_of_its_cluster_and_materials_have_their_colors():
    kick = clip("unreal")
    scene = fbx_writer._Writer(kick).scene()
    objects, connections = scene.first("Objects"), scene.first("Connections")
    assert objects is not None
    assert connections is not None
    names = {
        record.properties[0]: record.properties[1].partition("\0")[0]
        for record in objects.all("Model")
    }
    above = {
        record.properties[2]: names[record.properties[1]]
        for record in connections.all("C")
        if record.properties[1] in names and record.properties[0] == "OO"
    }
    (skin,) = kick.skins
    weights = np.zeros((len(skin.points), len(kick.joints)))
    for cluster in objects.all("Deformer"):
        if cluster.properties[2] == "Cluster":
            joint = kick.joints.index(above[cluster.properties[0]])
            weights[cluster.value("Indexes"), joint] += cluster.value("Weights")
    expected = np.zeros_like(weights)
    for bones, shares in zip(skin.bones.T, skin.weights.T, strict=True):
        expected[np.arange(len(expected)), np.array(skin.ordered)[bones]] += shares
    np.testing.assert_allclose(weights, expected, atol=1e-12)
    colors = []
    for material in objects.all("Material"):
        block = material.first("Properties70")
        assert block is not None
        colors.append(255 * np.array(next(block.all("P")).properties[4:]))
    np.testing.assert_allclose(colors, MATERIALS, atol=1e-9)


@pytest.mark.parametrize("fps", [20.0, 29.97, 30.0, 60.0])
def test_a_take_ends_with_its_last_key(fps: float):
    kick = replace(clip(None), fps=fps, skins=())
    scene = fbx_writer._Writer(kick).scene()
    objects, takes = scene.first("Objects"), scene.first("Takes")
    settings = scene.first("GlobalSettings")
    assert objects is not None
    assert takes is not None
    assert settings is not None
    keys = next(objects.all("AnimationCurve")).value("KeyTime")
    exact = np.arange(len(kick.turns)) / fps * fbx_scene.TICKS
    assert np.abs(keys - exact).max() <= 0.5 + 1e-3
    take = takes.first("Take")
    assert take is not None
    for name in ("LocalTime", "ReferenceTime"):
        span = take.first(name)
        assert span is not None
        assert span.properties == [0, keys[-1]]
    blocks = [settings, next(objects.all("AnimationStack"))]
    times = {
        entry.properties[0]: entry.properties[4]
        for block in blocks
        for entry in (block.first("Properties70") or Record("")).all("P")
        if entry.properties[1] == "KTime"
    }
    ends = dict.fromkeys(("LocalStop", "ReferenceStop", "TimeSpanStop"), keys[-1])
    assert times == {**ends, "TimeSpanStart": 0}


@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_contacts_in_fbx_files_are_held_until_the_frame_in_which_they_change(
    fps: float, tmp_path: Path
):
    poses = synthetic("kick").posed()
    contacts = np.zeros((12, 2), bool)
    contacts[3:7, 0], contacts[:5, 1], contacts[9:, 1] = True, True, True
    clip = rigged(poses, "kick", fps, preset("mixamo", poses))
    fbx_writer.write(tmp_path / "a.fbx", clip.part(slice(2, 14), "kick", contacts))
    root = fbx.read(tmp_path / "a.fbx")
    objects, connections = root.first("Objects"), root.first("Connections")
    assert objects is not None
    assert connections is not None
    records = {record.properties[0]: record for record in objects.children}
    targets = {
        (record.properties[1], name): record.properties[2]
        for record in connections.children
        for name in record.properties[3:]
    }
    for name, planted in zip(("LeftFootContact", "RightFootContact"), contacts.T, strict=True):
        ((node, bone),) = ((child, parent) for (child, to), parent in targets.items() if to == name)
        assert records[bone].properties[1].startswith("mixamorig:Hips\x00")
        (number,) = (
            child for (child, to), parent in targets.items() if (to, parent) == (f"d|{name}", node)
        )
        curve = fbx_scene._curve(records[number])
        frames = [0, *(np.flatnonzero(np.diff(planted)) + 1)]
        np.testing.assert_allclose(curve.times * fps, frames, atol=1e-6)
        for later in (0.0, 0.5, 0.9):
            values = curve.at((np.arange(12) + later) / fps)
            np.testing.assert_array_equal(values, planted)
