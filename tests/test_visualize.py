import base64
import io
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageSequence
from scipy.spatial.transform import Rotation
from support.browser import CHROMIUM, browser
from support.motions import HOSTILE, Page, frames_array, posed, sway, unpacked

from flame_mdm.errors import UserError
from flame_mdm.formats import WRITTEN
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import KIT21, SKELETONS, SMPL22
from flame_mdm.visualize import contact_sheet, render, write_gif, write_mp4, write_player
from flame_mdm.visualize.body import Figure, radii
from flame_mdm.visualize.player import packed_motion
from flame_mdm.visualize.render import SIDE_COLORS

try:
    import av
except ImportError:
    av: Any = None
MP4 = pytest.mark.skipif(av is None, reason="av is not installed: pip install flame-mdm[video]")


def test_player_holds_the_joints_to_half_a_millimetre_and_huge_ones_coarser(tmp_path, subtests):
    # Motions on one page may differ in length, rate and skeleton.
    motions = [
        sway(contacts=True),
        sway(7, 12.5, SKELETONS["kit21"]),
    ]
    write_player(tmp_path / "p.html", motions, "t")
    for number, (packed, motion) in enumerate(
        zip(Page(tmp_path / "p.html").motions, motions, strict=True)
    ):
        with subtests.test(motion=number):
            np.testing.assert_allclose(unpacked(packed), motion.joints, rtol=0, atol=0.0005 + 1e-6)
            assert (packed["fps"], packed["parents"]) == (motion.fps, list(motion.skeleton.parents))
    contacts = np.frombuffer(
        base64.b64decode(Page(tmp_path / "p.html").motions[0]["contacts"]), "u1"
    )
    np.testing.assert_array_equal(contacts.reshape(30, -1), motions[0].contacts)
    motions[0].joints *= 1000
    write_player(tmp_path / "p.html", motions[:1])
    (packed,), span = (
        Page(tmp_path / "p.html").motions,
        np.ptp(motions[0].joints, axis=(0, 1)).max(),
    )
    np.testing.assert_allclose(
        unpacked(packed), motions[0].joints, rtol=0, atol=span / 65534 / 2 + 1e-3
    )


def test_player_is_one_file_that_escapes_all_texts(tmp_path, subtests):
    write_player(tmp_path / "p.html", [sway(text=HOSTILE, id="a\u2066b")], HOSTILE)
    page = Page(tmp_path / "p.html")
    assert not {"link", "img", "iframe"} & set(page.tags)
    for reference in (
        "http:",
        "https:",
        'src="',
        "href=",
        "url(",
        "@import",
        "import(",
        "fetch(",
        "XMLHttpRequest",
    ):
        with subtests.test(reference=reference):
            assert reference not in page.source, reference
    assert page.tags.count("script") == 3
    assert page.texts["title"] == page.texts["h1"] == HOSTILE
    # The page does not rearrange texts.
    assert (page.motions[0]["caption"], page.motions[0]["id"]) == (
        HOSTILE,
        r"a\u2066b",
    )


@pytest.mark.parametrize("kind", ["known rotations", "joints of people", "other skeleton"])
@pytest.mark.parametrize(
    "ending", [*WRITTEN, ".html", ".png", "rigged.bvh", "rigged.glb", "character.glb"]
)
def test_nothing_warns_while_a_motion_is_written_or_drawn(tmp_path, ending, kind):
    if ending == ".mp4":
        pytest.importorskip("av", reason="av is not installed: pip install flame-mdm[video]")
    if ending.startswith(".usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed: pip install flame-mdm[usd]")
    solved = Motion(posed(2, left_knee=(60, 0, 0)).joints, 20)
    motions = {
        "known rotations": posed(2),
        "joints of people": solved,
        "other skeleton": sway(2, skeleton=KIT21),
    }
    posed(2).save(tmp_path / "rig.glb", rig="mixamo")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _write(motions[kind], tmp_path / f"a{ending}")


def _write(motion: Motion, path: Path) -> None:
    """Writes a file; only files of positions and pictures can contain a skeleton other than SMPL's."""
    options = {"arigged": {"rig": "unreal"}, "acharacter": {"character": path.with_name("rig.glb")}}
    if path.suffix == ".html":
        write_player(path, [motion])
    elif path.suffix == ".png":
        contact_sheet(path, [motion])
    elif motion.skeleton is KIT21 and path.suffix not in (".npz", ".json", ".npy", ".gif", ".mp4"):
        with pytest.raises(UserError, match="computed only for SMPL's 22 joints"):
            motion.save(path, **options.get(path.stem, {}))
    else:
        motion.save(path, **options.get(path.stem, {}))


def test_a_figure_of_joints_alone_is_drawn_as_a_skeleton(tmp_path):
    figure = Figure(posed().joints, 20)
    write_player(tmp_path / "p.html", [figure, posed()])
    skeleton, body = Page(tmp_path / "p.html").motions
    assert skeleton["body"] is None
    assert "rotations" in skeleton["why"]
    assert body["body"]


# Pixels of both sides and of clothes in the first panel
PIXELS = """(() => {
  redraw();
  const { canvas } = motions[0], { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const seen = { blue: 0, orange: 0, dark: 0 };
  for (let i = 0; i < data.length; i += 4) {
    seen.blue += data[i + 2] > data[i] + 80; seen.orange += data[i] > data[i + 2] + 80;
    seen.dark += data[i] + data[i + 1] + data[i + 2] < 260;
  }
  return seen;
})()"""


@pytest.mark.tools
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_player_runs_in_a_browser(tmp_path):
    write_player(
        tmp_path / "p.html", [sway(contacts=True, text=HOSTILE, id=f"m{k}") for k in range(13)], "t"
    )
    with browser(tmp_path / "profile", 900, 700) as tab:
        tab.open((tmp_path / "p.html").as_uri())
        tab.wait("typeof motions === 'object' && motions.length === 13 && !!motions[12].figure")
        tab.run("goTo(7)")
        clothes = tab.run(PIXELS)
        tab.run("tint.click()")
        sides, button = tab.run(PIXELS), tab.run("figure.textContent")
        tab.run("figure.click()")
        sticks = tab.run(PIXELS)
        assert [button, tab.run("figure.textContent")] == ["Skeleton", "Body"]
        shown = "[scrub.value, scrub.max, filter.hidden, motions[0].joints.length, document.images.length]"
        assert tab.run(shown) == ["7", "29", False, 30 * 22 * 3, 0]
        assert tab.run("document.querySelector('figcaption p').textContent") == HOSTILE
        assert tab.errors == []
    assert clothes["orange"] < 20
    assert clothes["dark"] > 200  # trousers, shoes and hair
    assert min(sides["blue"], sides["orange"], sticks["blue"], sticks["orange"]) > 50
    assert sides["blue"] != sticks["blue"]


def test_gif_keeps_frames_and_time_and_holds_a_motion_that_ended(tmp_path, subtests):
    for fps, frames, shown in (
        *((20, 30, 30), (30, 30, 30), (12.5, 10, 10), (120, 120, 40)),
        *((5, 4, 4), (50, 4, 4), (60, 4, 2), (100, 4, 2)),
    ):
        with subtests.test(fps=fps):
            write_gif(tmp_path / "m.gif", [sway(frames, fps, text="walks")], size=64)
            with Image.open(tmp_path / "m.gif") as image:
                durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
                assert image.info["loop"] == 0
            assert len(durations) == shown
            assert sum(durations) == pytest.approx(1000 * frames / fps, abs=5)
            assert min(durations) >= 20  # browsers slow shorter ones down
            assert max(durations) - min(durations) <= 10
    write_gif(tmp_path / "m.gif", [sway(8), sway(16)], size=64)
    with Image.open(tmp_path / "m.gif") as image:
        assert image.width == 128
        frames = [np.asarray(frame.convert("RGB"))[:64] for frame in ImageSequence.Iterator(image)]
    assert len(frames) == 16
    np.testing.assert_array_equal(frames[8][:, :64], frames[15][:, :64])
    assert (frames[8][:, 64:] != frames[15][:, 64:]).any()


def test_motions_of_different_rates_show_the_frame_of_each_time(monkeypatch):
    shown: list[tuple[str, int]] = []

    def draw(motion: Figure, body: Any, frame: int, size: int) -> Image.Image:
        shown.append((motion.id, frame))
        return Image.new("RGB", (size, size))

    monkeypatch.setattr(render, "_figure", draw)
    motions = [sway(6, 30, id="fast"), sway(3, 20, id="slow"), sway(1, 10, id="still")]
    assert len(list(render._video(motions, 30, 32, None))) == 6
    frames = {name: [k for id, k in shown if id == name] for name in ("fast", "slow", "still")}
    assert frames == {"fast": [0, 1, 2, 3, 4, 5], "slow": [0, 0, 1, 2, 2, 2], "still": [0] * 6}
    assert len(list(render._video([sway(3, 20)], 30, 32, None))) == 5, "0.15 s are 4.5 images"


def test_a_picture_shows_the_path_up_to_its_frame_and_no_frame_after_half_a_second():
    joints = sway(40).joints
    later = joints.copy()
    later[31:] += [0.5, 0, 0.5]
    motions = (Motion(joints, 20), Motion(later, 20))
    first, second = (np.asarray(render._figure(motion, None, 20, 128)) for motion in motions)
    np.testing.assert_array_equal(first, second)

    def violet(frame: int) -> int:
        image = np.asarray(render._figure(motions[0], None, frame, 128))
        return int((np.abs(image.astype(int) - render.TRAIL).max(2) < 40).sum())

    counts = [violet(frame) for frame in (0, 10, 20)]
    assert counts[0] < counts[1] < counts[2] - 5, counts


@pytest.mark.parametrize(
    ("count", "columns", "rows"),
    [(1, 1, 1), (3, 3, 1), (4, 2, 2), (5, 3, 2), (9, 3, 3), (10, 4, 3), (17, 4, 5)],
)
def test_panels_stand_in_at_most_four_columns(monkeypatch, count, columns, rows):
    monkeypatch.setattr(
        render, "_figure", lambda motion, body, frame, size: Image.new("RGB", (size, size))
    )
    figure = Figure(sway(1).joints, 20, text="a")
    (image,) = render._video([figure] * count, 20, 32, None)
    assert image.width == 32 * columns
    assert image.height // rows >= 32
    assert (image.height - 3) % rows == 0


def test_the_camera_follows_the_mean_root_of_a_second(monkeypatch):
    centers, original = [], render._camera

    def camera(center: np.ndarray, side: int) -> Any:
        centers.append(center.tolist())
        return original(center, side)

    monkeypatch.setattr(render, "_camera", camera)
    joints = sway(40).joints * 0
    joints[..., 0] += np.arange(40)[:, None]
    joints[..., 1] += 2.0
    for frame in (0, 20, 38):
        render._figure(Figure(joints, 20), None, frame, 16)
    render._figure(Figure(joints * [1, 0.45, 1], 20), None, 20, 16)
    np.testing.assert_allclose(
        centers, [[5, 1.75, 0], [20, 1.75, 0], [33.5, 1.75, 0], [20, 0.85, 0]]
    )


def test_a_foot_is_marked_in_the_frames_of_its_contact():
    joints = sway(3).joints

    def green(foot: int, frame: int) -> np.ndarray:
        contacts = np.zeros((3, 4), bool)
        contacts[1, foot] = True
        image = np.asarray(render._figure(Figure(joints, 20, contacts=contacts), None, frame, 128))
        red, green, blue = image.astype(int).transpose(2, 0, 1)
        return np.nonzero((green > red + 60) & (green > blue + 20))[1]

    assert [len(green(1, frame)) > 0 for frame in range(3)] == [False, True, False]
    assert green(1, 1).mean() > green(3, 1).mean(), "the left foot is on the right of the picture"


def test_a_thumbnail_shows_the_pose_farthest_from_the_first(monkeypatch):
    motion, shown, original = sway(5), [], render._figure
    motion.joints[:] = motion.joints[0]
    motion.joints[:, :, 0] += np.arange(5)[:, None]
    motion.joints[2, 20] += 0.5
    motion.joints[3, 20:22] += 0.3
    motion.joints[4, :, 1] -= 0.2  # a body that is lower has a different pose

    def draw(motion: Figure, body: Any, frame: int, size: int) -> Image.Image:
        shown.append(frame)
        return original(motion, body, frame, size)

    monkeypatch.setattr(render, "_figure", draw)
    image = Image.open(io.BytesIO(render.thumbnail(motion, 60)))
    assert shown == [4]
    assert (image.format, image.size) == ("WEBP", (42, 60))


def test_poses_of_a_contact_sheet_are_labeled_with_their_seconds(tmp_path, monkeypatch):
    texts, original = [], ImageDraw.ImageDraw.text

    def write(pen: Any, at: Any, text: str, *args: Any) -> None:
        texts.append(text)
        original(pen, at, text, *args)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", write)
    contact_sheet(tmp_path / "sheet.png", [sway(30, 12.5, text="walks")], frames=3, size=96)
    assert texts[:3] == ["0.00 s", "1.12 s", "2.32 s"]


def test_radii_grow_with_the_number_of_joints_below():
    at = dict(zip(SMPL22.joints, radii(SMPL22), strict=True))
    names = ("head", "right_foot", "left_ankle", "left_hip", "spine3", "pelvis")
    expected = [0.024 + 0.011 * below**0.5 for below in (0, 0, 1, 3, 10, 21)]
    assert [at[name] for name in names] == pytest.approx(expected, abs=1e-4)


def test_a_player_that_starts_later_has_the_same_frames():
    motion = posed(12, heading=np.linspace(0, 2, 12), left_elbow=(0, -80, 0))
    motion.contacts = np.arange(48).reshape(12, 4) % 3 == 0
    whole, late = (packed_motion(motion, begin) for begin in (0, 5))
    assert (whole["frames"], late["frames"]) == (12, 7)
    parts = ((whole["joints"], late["joints"]), (whole["contacts"], late["contacts"]))
    for complete, part in (*parts, (whole["body"]["turns"], late["body"]["turns"])):
        all_bytes, last_bytes = map(base64.b64decode, (complete, part))
        assert all_bytes[len(all_bytes) * 5 // 12 :] == last_bytes
    for name in ("center", "step", "fps", "feet"):
        assert whole[name] == late[name], name


def test_packed_rotations_are_exact_to_a_tenth_of_a_degree():
    rng = np.random.default_rng(0)
    motion = posed(30, heading=rng.uniform(-3, 3, 30), left_hip=rng.normal(0, 40, (30, 3)))
    fitted, _ = motion.try_fit()
    assert fitted is not None
    values = np.frombuffer(base64.b64decode(packed_motion(motion)["body"]["turns"]), "<u4")
    largest, parts = values >> 30, np.stack([values >> 20, values >> 10, values], 1) & 1023
    parts = (parts / 1023 - 0.5) * 2**0.5
    quaternions = np.empty((len(values), 4))
    quaternions[np.arange(4) != largest[:, None]] = parts.ravel()
    rest = np.sqrt(1 - (parts**2).sum(1))
    quaternions[np.arange(len(values)), largest] = rest
    turned = Rotation.from_matrix(fitted.turns.reshape(-1, 3, 3))
    off = np.degrees((Rotation.from_quat(quaternions) * turned.inv()).magnitude())
    assert off.max() < 0.2
    assert set(largest.tolist()) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    "write", [write_player, write_gif, pytest.param(write_mp4, marks=MP4), contact_sheet]
)
def test_writers_give_the_same_bytes_and_leave_nothing_where_they_fail(tmp_path, write):
    with pytest.raises(UserError, match=r"out\.x: no motions to show"):
        write(tmp_path / "out.x", [])
    assert list(tmp_path.iterdir()) == []
    for name in "ab":
        write(tmp_path / name, [sway(5, contacts=True, text="walks")])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_frames_show_both_sides_and_height_of_a_skeleton(subtests):
    motion = sway(3, skeleton=SKELETONS["kit21"])
    frames = frames_array(motion, size=128)
    assert frames.shape == (3, 128, 128, 3)
    motion.joints[:, :, 1] += 0.3
    images = [frames[0].astype(int), frames_array(motion, size=128)[0].astype(int)]
    for side in (-1, 1):
        with subtests.test(side=side):
            rows, lifted = (
                np.nonzero((np.abs(image - SIDE_COLORS[side]) < 12).all(-1))[0] for image in images
            )
            assert len(rows) > 30
            assert rows.mean() - lifted.mean() == pytest.approx(0.3 * 2.05 * 128 / 5, rel=0.2)


def test_contact_sheet_shows_first_to_last_pose_of_each_motion(tmp_path):
    motions = [sway(30, text="walks"), sway(4, text="walks briefly")]
    contact_sheet(tmp_path / "sheet.png", motions, frames=3, size=96)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    assert sheet.shape[1:] == (3 * 96, 3)
    last = frames_array(motions[0], size=96)[-1]
    np.testing.assert_array_equal(sheet[24:96, -96:], last[24:])  # the time stands above
    np.testing.assert_array_equal(
        sheet[sheet.shape[0] // 2 + 24 :][:60, :96], frames_array(motions[1], 96)[0][24:84]
    )


@pytest.mark.slow
@MP4
def test_mp4_has_the_frames_of_the_motion_and_the_colors_of_the_gif(tmp_path, subtests):
    for fps, size in ((12.5, 65), (29.97, 64), (120, 64)):
        with subtests.test(fps=fps, size=size):
            write_mp4(tmp_path / "m.mp4", [sway(12, fps, text="walks"), sway(5, fps)], size=size)
            with av.open(str(tmp_path / "m.mp4")) as file:
                stream, frames = file.streams.video[0], list(file.decode(video=0))
                assert (stream.codec_context.name, stream.codec_context.pix_fmt) == (
                    "h264",
                    "yuv420p",
                )
                assert float(stream.average_rate or 0) == pytest.approx(fps, rel=1e-6)
            assert len(frames) == 12
            assert (frames[-1].time or 0) - (frames[0].time or 0) == pytest.approx(
                11 / fps, rel=1e-3
            )
            assert (frames[0].width, frames[0].height % 2) == (2 * size, 0)

    # it shows what a GIF shows, in its colors
    motions = [sway(8, text="walks"), sway(16)]
    assert (
        motions[0]
        .save(tmp_path / "m.MP4")
        .endswith("m.MP4: 8 frames at 20 per second, H.264 video")
    )
    assert (tmp_path / "m.MP4").read_bytes().startswith(b"\0\0\0\x20ftyp")
    write_gif(tmp_path / "m.gif", motions, size=128)
    write_mp4(tmp_path / "m.mp4", motions, size=128)
    with Image.open(tmp_path / "m.gif") as image:
        shown = np.stack(
            [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(image)]
        )
    with av.open(str(tmp_path / "m.mp4")) as file:
        video = np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])
    assert len(video) == len(shown) == 16
    shown = shown[:, : video.shape[1]]
    off = np.abs(video[:, None] - shown[None]).mean((2, 3, 4))
    assert (off.argmin(1) == np.arange(16)).all()
    assert off.diagonal().max() < 2.5


def test_mp4_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(
        UserError,
        match=r'm\.mp4: MP4 requires the av package\. Run pip install "flame-mdm\[video\]", or',
    ):
        write_mp4(tmp_path / "m.mp4", [sway(2)])
    assert list(tmp_path.iterdir()) == []


def test_bad_motions_are_refused_by_name(subtests):
    joints = sway(4).joints
    joints[2, 5, 1] = np.nan
    good = {"joints": np.zeros((4, 22, 3)), "fps": 20, "skeleton": SKELETONS["smpl22"], "id": "m"}
    for change, message in (
        ({"joints": joints}, "'m': the position of joint 5 in frame 2 is NaN or infinite"),
        ({"joints": np.zeros((0, 22, 3))}, r"'m': joints have shape \(0, 22, 3\)"),
        (
            {"joints": np.zeros((4, 24, 3))},
            r"'m': joints have shape \(4, 24, 3\), but smpl22 needs \(frames, 22, 3\)",
        ),
        ({"fps": 0}, "'m': fps is 0"),
        ({"fps": float("nan")}, "'m': fps is nan"),
        ({"contacts": np.zeros((3, 4))}, r"contacts have shape \(3, 4\), expected \(4, 4\)"),
    ):
        with subtests.test(change=change, message=message), pytest.raises(UserError, match=message):
            Motion(**{**good, **change})


def test_the_camera_stands_in_front_of_the_body_to_its_left_and_above():
    center = np.array([1.0, 0.9, 2.0])
    project = render._camera(center, 200)
    np.testing.assert_allclose(project(center[None]), [[100, 100, 82, 5]], atol=1e-9)
    steps = 0.2 * np.eye(3)
    left, up, ahead = project(center + steps)
    assert left[0] > 100 + 10
    assert up[1] < 100 - 10
    assert abs(up[0] - 100) < 1e-9
    assert ahead[0] < 100
    assert min(left[3], up[3], ahead[3]) > 4.7
    assert max(left[3], up[3], ahead[3]) < 5
    behind = project(center + 9 * render.TOWARD[None])
    assert behind[0, 3] == 0.3, "never closer than this"


def test_surfaces_are_lit_from_the_upper_left_of_the_camera():
    normals = np.array([-render.RIGHT, render.RIGHT, [0, 1, 0], [0, -1, 0], render.TOWARD])
    left, right, above, below, ahead = render._shaded(normals, np.full((5, 3), 100.0))[:, 0]
    assert above > ahead > left > right > below
    assert (right, below) == pytest.approx((50, 38))
    assert render._shaded(normals, np.full((5, 3), 255.0)).max() == 255


def test_a_caption_has_at_most_three_lines():
    lines = render._lines(sway(text="a person walks " * 9), posed().try_fit()[0], 192, 192)
    assert len(lines) == 3
    assert lines[2].endswith(" …")
    assert render._lines(sway(text="walks"), None, 192, 192) == ["walks", "(no body fits)"]


def test_the_bar_below_the_panels_grows_until_the_last_image(monkeypatch):
    monkeypatch.setattr(
        render, "_figure", lambda motion, body, frame, size: Image.new("RGB", (size, size), "white")
    )
    images = list(render._video([Figure(sway(4).joints, 20, text="a")] * 2, 20, 64, None))
    rows = [np.asarray(image)[-3:] for image in images]
    lengths = [(row == render.TRAIL).all(-1).all(0).sum() for row in rows]
    assert lengths == pytest.approx([32, 64, 96, 128], abs=1)


def test_a_page_holds_what_its_script_needs_to_draw_the_body(tmp_path):
    """As in the page: the mesh is fitted to the body at rest, and then each bone moves it."""
    turns: dict[str, Any] = {"left_hip": (-50, 10, 0), "left_knee": (70, 0, 0)}
    motion = posed(3, 0.93, heading=[0.3, 1.5, 2.8], right_elbow=(0, 60, 0), **turns)
    write_player(tmp_path / "p.html", [motion])
    page = Page(tmp_path / "p.html")
    (packed,), mesh = page.motions, json.loads(page.texts["body"])

    def array(text: str, kind: str, width: int) -> np.ndarray:
        return np.frombuffer(base64.b64decode(text), kind).reshape(-1, width).astype(float)

    anchors, joints = mesh["anchors"], np.reshape(mesh["joints"], (22, 3))
    weights = np.zeros((len(array(mesh["points"], "<i2", 3)), len(anchors)))
    for bone, weight in zip(
        array(mesh["bones"], "u1", 4).T, array(mesh["weights"], "u1", 4).T, strict=True
    ):
        weights[np.arange(len(weights)), bone.astype(int)] += weight / 255

    def moved(points: np.ndarray, matrices: np.ndarray, start: Any, end: Any) -> np.ndarray:
        by_bone = np.einsum("bij,vbj->vbi", matrices, points[:, None] - start[anchors])
        return np.einsum("vb,vbi->vi", weights, by_bone + end[anchors])

    fit = array(packed["body"]["fit"], "<f4", 9).reshape(-1, 3, 3)
    rest = array(packed["body"]["rest"], "<f4", 3)
    points = moved(array(mesh["points"], "<i2", 3) / 20000, fit[anchors], joints, rest)
    bits = array(packed["body"]["turns"], "<u4", len(anchors)).astype(np.uint32)
    drawn, _ = motion.try_fit()
    assert drawn is not None
    for frame, row in enumerate(bits):
        parts = (np.stack([row >> 20, row >> 10, row], 1) & 1023) / 1023 - 0.5
        quaternions = [
            np.insert(part, largest, np.sqrt(1 - (part**2).sum()))
            for part, largest in zip(2**0.5 * parts, row >> 30, strict=True)
        ]
        turned = Rotation.from_quat(quaternions).as_matrix()
        ends = unpacked(packed)[frame] + [0, packed["body"]["lift"], 0]
        vertices = moved(points, turned, rest, ends)
        np.testing.assert_allclose(vertices, drawn.skinned(frame)[0], atol=3e-3)


def test_lines_on_the_ground_are_at_whole_meters():
    joints = sway(3).joints.astype(float)

    def picture(offset: list[float]) -> np.ndarray:
        figure = Figure(joints + np.array(offset), 20)
        return np.asarray(render._figure(figure, None, 1, 96)).astype(int)

    first = picture([0, 0, 0])
    assert np.abs(picture([2, 0, -3]) - first).mean() < 0.05
    assert np.abs(picture([0.5, 0, 0]) - first).mean() > 0.5
    assert np.abs(picture([0, 0, 0.5]) - first).mean() > 0.5


def test_groups_neighbors_and_marks_of_a_page_belong_to_their_motions(tmp_path):
    motions = [sway(4, id="a"), sway(5, id="b"), sway(6, id="c")]
    marks = [[(1, 3, "pop", "head")], [], [(0, 2, "skating", "toe"), (4, 6, "pop", "knee")]]
    options: dict[str, Any] = {"groups": ["x", "", "y"], "beside": ["", "a", ""], "marks": marks}
    write_player(tmp_path / "p.html", motions, columns=3, about="<b>text</b>", **options)
    page = Page(tmp_path / "p.html")
    shown = [
        [motion[key] for key in ("id", "group", "beside", "frames")] for motion in page.motions
    ]
    assert shown == [["a", "x", "", 4], ["b", "", "a", 5], ["c", "y", "", 6]]
    assert [motion["marks"] for motion in page.motions] == json.loads(json.dumps(marks))
    assert "<details><summary>About these motions</summary><div><b>text</b></div>" in page.source
    assert "fixed = 3," in page.source
