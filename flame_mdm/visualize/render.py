"""Still images and videos of motions, drawn with Pillow."""

import io
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from importlib import import_module
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from flame_mdm.errors import UserError, shortened
from flame_mdm.safe_io import atomic_write
from flame_mdm.visualize.body import MATERIALS, Figure, FittedBody, Mesh, head, radii, sides, target

Color = tuple[int, int, int]
SIDE_COLORS: dict[int, Color] = {1: (47, 127, 209), -1: (226, 112, 42), 0: (140, 149, 163)}
RIM_COLORS: dict[int, Color] = {1: (26, 70, 115), -1: (124, 62, 23), 0: (77, 82, 90)}
PAPER = (255, 255, 255)
GROUND = (243, 245, 247)
LINE = (205, 211, 219)
TEXT = (28, 36, 48)
FAINT = (102, 112, 133)
SHADOW, TRAIL, CONTACT = (212, 216, 222), (122, 91, 208), (15, 157, 107)
# Objects that are closer to the camera than this, in meters, are not drawn
NEAR = 0.3
# Angles in radians of the camera, which is in front of the body, to its left, and above it
YAW, PITCH = 0.6, 0.24
TOWARD = np.array(
    [math.sin(YAW) * math.cos(PITCH), math.sin(PITCH), math.cos(YAW) * math.cos(PITCH)]
)
RIGHT = np.array([math.cos(YAW), 0, -math.sin(YAW)])
# Code of the HD color space, which players assume for large videos that do not declare theirs
BT709 = 1
SMOOTH = 2  # images are drawn larger by this factor and then downscaled


def write_gif(
    path: str | Path, motions: Sequence[Figure], size: int = 256, body: Mesh | None = None
) -> None:
    """Writes a looping animation that shows motions side by side, with a caption below each.

    Each motion is shown in a panel that is `size` pixels wide. GIF allows at most 50 frames per
    second, so the highest frame rate of the motions is divided by the smallest integer that results
    in 50 or less. For example, 60 fps becomes 30 fps, and 120 fps becomes 40 fps. Shorter motions
    hold their last frame. `body` is the body to draw, or None for the mannequin.
    """
    path = target(path, motions)
    fps = max(motion.fps for motion in motions)
    fps /= math.ceil(fps / 50)
    palette = _palette()
    images = [
        image.quantize(palette=palette, dither=Image.Dither.NONE)
        for image in _video(motions, fps, size, body)
    ]
    # GIF durations are in hundredths of a second. The times of the frames are rounded instead of
    # the durations, so that errors do not accumulate.
    times = np.rint(100 * np.arange(len(images) + 1) / fps).astype(int)
    options = {"append_images": images[1:], "duration": (10 * np.diff(times)).tolist(), "loop": 0}
    with atomic_write(path) as temporary:
        images[0].save(temporary, format="GIF", save_all=True, **options)


def write_mp4(
    path: str | Path, motions: Sequence[Figure], size: int = 384, body: Mesh | None = None
) -> None:
    """Writes the animation of `write_gif` as an H.264 video (yuv420p) at any frame rate."""
    path = target(path, motions)
    try:
        av = import_module("av")
    except ImportError:
        raise UserError(
            f'{path}: MP4 requires the av package. Run pip install "flame-mdm[video]", or save a .gif file'
        ) from None
    fps = max(motion.fps for motion in motions)
    with (
        atomic_write(path) as temporary,
        av.open(str(temporary), "w", "mp4", {"movflags": "+faststart"}) as file,
    ):
        stream = file.add_stream("libx264", Fraction(fps).limit_denominator(1001), {"crf": "20"})
        stream.thread_count = 1  # with one thread, the file does not depend on the number of cores
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = BT709
        for image in _video(motions, fps, size, body):
            if not context.is_open:
                # H.264 requires even widths and heights
                context.width = image.width // 2 * 2
                context.height = image.height // 2 * 2
            pixels = np.asarray(image)[: context.height, : context.width]
            frame = av.VideoFrame.from_ndarray(pixels).reformat(
                format="yuv420p", dst_colorspace=BT709
            )
            file.mux(stream.encode(frame))
        file.mux(stream.encode())


def contact_sheet(
    path: str | Path,
    motions: Sequence[Figure],
    frames: int = 6,
    size: int = 192,
    body: Mesh | None = None,
) -> None:
    """Writes a PNG image with one row per motion.

    Each row contains a caption and `frames` poses, which are equally spaced in time and `size`
    pixels wide.
    """
    path = target(path, motions)
    rows = []
    for motion in motions:
        fitted, _ = motion.try_fit(body)
        row = Image.new("RGB", (frames * size, size), PAPER)
        pen = ImageDraw.Draw(row)
        for k, frame in enumerate(
            np.rint(np.linspace(0, len(motion.joints) - 1, frames)).astype(int).tolist()
        ):
            row.paste(_figure(motion, fitted, frame, size), (k * size, 0))
            pen.text((k * size + 8, 6), f"{frame / motion.fps:.2f} s", FAINT, _font(size))
        lines = _lines(motion, fitted, row.width, size)
        rows.append(_below(row, _caption(lines, row.width, len(lines), size)))
    sheet = Image.new("RGB", (frames * size, sum(row.height for row in rows)), PAPER)
    top = 0
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG", optimize=True)


def thumbnail(motion: Figure, height: int = 120) -> bytes:
    """Returns a WebP image of the pose that differs most from the first pose.

    The image is `height` pixels high, and its width is 0.7 times its height.
    """
    poses = motion.joints - motion.joints[:, :1] * [1, 0, 1]
    frame = int(np.linalg.norm(poses - poses[0], axis=2).sum(1).argmax())
    image = _figure(motion, motion.try_fit()[0], frame, round(height / 0.92))
    left, content = (image.width - 0.7 * height) / 2, io.BytesIO()
    image.crop((round(left), 0, round(left + 0.7 * height), height)).save(
        content, "WEBP", quality=85
    )
    return content.getvalue()


def _palette() -> Image.Image:
    """Returns a single palette for all frames, so that colors do not flicker.

    The palette contains all colors, as well as the blends between them that occur at smoothed
    edges.
    """
    drawn = np.array(
        [*SIDE_COLORS.values(), *RIM_COLORS.values(), LINE, TEXT, FAINT, SHADOW, TRAIL, CONTACT]
    )
    light = np.linspace(0.4, 1.12, 26)[:, None]
    body = np.concatenate([np.minimum(light * color, 255) for color in MATERIALS])
    grounds = np.array([PAPER, GROUND])
    blends = [back + part * (drawn - back) for back in grounds for part in (0.25, 0.5, 0.75)]
    image = Image.new("P", (1, 1))
    image.putpalette(
        np.rint(np.concatenate([grounds, drawn, *blends, body])).astype("u1").tobytes()
    )
    return image


def _video(
    motions: Sequence[Figure], fps: float, size: int, mesh: Mesh | None
) -> Iterator[Image.Image]:
    """For every 1 / fps seconds of motion, yields an image of all panels and a progress bar."""
    seconds = max(len(motion.joints) / motion.fps for motion in motions)
    columns = len(motions) if len(motions) < 4 else min(4, math.ceil(math.sqrt(len(motions))))
    bodies = [motion.try_fit(mesh)[0] for motion in motions]
    lines = [_lines(motion, body, size, size) for motion, body in zip(motions, bodies, strict=True)]
    captions = [_caption(text, size, max(map(len, lines)), size) for text in lines]
    count = max(1, math.ceil(seconds * fps - 1e-6))

    def draw(k: int, frame: int) -> Image.Image:
        return _below(_figure(motions[k], bodies[k], frame, size), captions[k])

    with ThreadPoolExecutor(min(len(motions), os.cpu_count() or 1)) as pool:
        for tick in range(count):
            # After its end, a motion holds its last frame
            now = [
                min(int(tick / fps * motion.fps + 1e-6), len(motion.joints) - 1)
                for motion in motions
            ]
            panels = list(pool.map(draw, range(len(motions)), now))
            height = panels[0].height
            image = Image.new(
                "RGB", (columns * size, math.ceil(len(motions) / columns) * height + 3), PAPER
            )
            for k, panel in enumerate(panels):
                image.paste(panel, (k % columns * size, k // columns * height))
            done = image.width * (tick + 1) / count
            ImageDraw.Draw(image).rectangle((0, image.height - 3, done, image.height), TRAIL)
            yield image


def _figure(motion: Figure, body: FittedBody | None, frame: int, size: int) -> Image.Image:
    """Draws a pose on the ground, as a body or a skeleton.

    The camera follows the smoothed root.
    """
    side = size * SMOOTH
    image = Image.new("RGB", (side, side), PAPER)
    pen = ImageDraw.Draw(image)
    joints = motion.joints[frame].astype(float)
    half = round(motion.fps / 2)
    x, y, z = motion.joints[max(0, frame - half) : frame + half + 1, 0].mean(0).tolist()
    # The camera rises with a body that climbs, but not with a jump
    project = _camera(np.array([x, max(0.85, y - 0.25), z]), side)
    pixel = size / 256 * SMOOTH

    ring, middle = np.linspace(0, 2 * np.pi, 49)[:, None], np.array([x, 0, z])
    pen.polygon(
        _points(project(middle + 3 * np.hstack([np.cos(ring), 0 * ring, np.sin(ring)]))), GROUND
    )
    for k in range(-3, 4):
        for point, along in (([round(x) + k, 0, z], [0, 0, 1]), ([x, 0, round(z) + k], [1, 0, 0])):
            inside = 9 - ((point - middle) ** 2).sum()
            if inside > 0:
                reach = inside**0.5 * np.array(along)
                pen.line(
                    _points(project(np.stack([point - reach, point + reach]))), LINE, round(pixel)
                )

    floor = np.array([1.0, 0.0, 1.0])
    root = motion.joints[: frame + 1, 0] * floor
    root = root[np.linalg.norm(root - middle, axis=1) < 3]
    if len(root) > 1:
        pen.line(_points(project(root)), TRAIL, round(1.5 * pixel))
    shadow = project(joints * floor)
    soft = shadow * [0.25, 0.25, 0.25, 1]  # drawn smaller and then enlarged
    dark = Image.new("L", (side // 4, side // 4))
    for parent, joint in motion.skeleton.edges:
        _capsule(ImageDraw.Draw(dark), soft[parent], soft[joint], 0.055, 255)
    dark = dark.filter(ImageFilter.BoxBlur(size / 192))
    # The part is enlarged together with a margin, so that its edge looks as if the whole image had
    # been enlarged.
    if box := dark.getbbox():
        left, top, right, bottom = max(0, box[0] - 4), max(0, box[1] - 4), box[2] + 4, box[3] + 4
        dark = dark.crop((left, top, right, bottom)).resize(
            (4 * (right - left), 4 * (bottom - top))
        )
        image.paste(SHADOW, (4 * left, 4 * top), dark)
    if motion.contacts is not None:
        for joint in np.array(motion.skeleton.feet)[motion.contacts[frame]]:
            cx, cy, scale = shadow[joint][:3]
            pen.ellipse(
                (cx - 0.06 * scale, cy - 0.02 * scale, cx + 0.06 * scale, cy + 0.02 * scale),
                CONTACT,
            )
    if body is not None:
        points, normals = body.skinned(frame)
        at, pixels = project(points), np.array(image)
        _rasterize(
            pixels, at[:, :2], at[:, 3], _shaded(normals, body.mesh.colors), body.mesh.triangles
        )
        return Image.fromarray(pixels).reduce(SMOOTH)
    _draw_skeleton(pen, motion, joints, project, pixel)
    return image.reduce(SMOOTH)


def _camera(center: np.ndarray, side: int) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that projects points (N, 3) in meters.

    The function returns an array (N, 4) with x, y, pixels per meter and depth.
    """

    def project(points: np.ndarray) -> np.ndarray:
        offset = points - center
        depth = np.maximum(5.0 - offset @ TOWARD, NEAR)
        scale = 2.05 * side / depth
        up = np.cross(TOWARD, RIGHT)
        return np.stack(
            [side / 2 + offset @ RIGHT * scale, side / 2 - offset @ up * scale, scale, depth], 1
        )

    return project


def _shaded(normals: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Returns the colors (V, 3) of a surface that is lit from the upper left of the camera."""
    light = TOWARD - 0.7 * RIGHT + [0, 1.2, 0]
    lit = np.maximum(normals @ (light / np.linalg.norm(light)), 0)
    return np.clip(colors * (0.5 + 0.12 * normals[:, 1] + 0.52 * lit)[:, None], 0, 255)


def _rasterize(
    image: np.ndarray, at: np.ndarray, depth: np.ndarray, colors: np.ndarray, triangles: np.ndarray
) -> None:
    """Draws triangles on an image. Each pixel shows the triangle nearest to the camera.

    Colors are interpolated between the corners. The image has the shape (height, width, 3) and the
    type uint8. `at` (V, 2) contains the pixel coordinates of the vertices, with y pointing down.
    `depth` (V,) contains their distances from the camera, and `colors` (V, 3) contains values from
    0 to 255. Triangles (T, 3) whose corners appear clockwise are seen from inside, so they are not
    drawn.
    """
    lowest = np.clip(np.floor(at.min(0)), 0, image.shape[1::-1]).astype(int)
    highest = np.clip(np.ceil(at.max(0)), lowest, image.shape[1::-1]).astype(int)
    width, height = highest - lowest
    a, b, c = (at - lowest)[triangles.T]
    (bx, by), (cx, cy) = (b - a).T, (c - a).T
    twice = bx * cy - by * cx
    seen = twice < -1e-9
    low = np.clip(np.ceil(np.minimum(np.minimum(a, b), c) - 0.5), 0, [width, height]).T
    high = np.clip(np.floor(np.maximum(np.maximum(a, b), c) + 0.5), 0, [width, height]).T
    wide, tall = np.maximum(high - low, 0).astype(int)
    count = np.where(seen, wide * tall, 0)
    # The weights of the second and third corner at a pixel are linear functions of the pixel's
    # column and row in the bounding box.
    twice = np.where(seen, twice, 1)
    right, down = low + 0.5 - a.T
    table = [right * cy - down * cx, cy, -cx, down * bx - right * by, -by, bx]
    table = np.stack([row / twice for row in table] + [wide, low[0] + low[1] * width]).astype(
        np.float32
    )
    second, second_x, second_y, third, third_x, third_y, wide, first = np.repeat(
        table, count, axis=1
    )
    step = np.arange(len(wide)) - np.repeat(np.cumsum(count) - count, count)
    y, x = np.divmod(step.astype(np.float32), wide)
    second += x * second_x + y * second_y
    third += x * third_x + y * third_y
    inside = np.flatnonzero((second >= 0) & (third >= 0) & (second + third <= 1))
    corners = triangles[np.repeat(np.arange(len(triangles)), count)[inside]].T
    second, third = second[inside], third[inside]
    pixel = (first[inside] + x[inside] + y[inside] * width).astype(int)
    shares = np.stack([1 - second - third, second, third])
    near = (shares * depth.astype(np.float32)[corners]).sum(0)
    nearest = np.full(width * height, np.inf, np.float32)
    np.minimum.at(nearest, pixel, near)
    seen = np.flatnonzero(near == nearest[pixel])
    mixed = (shares[:, seen, None] * colors.astype(np.float32)[corners[:, seen]]).sum(0)
    y, x = np.divmod(pixel[seen], width)
    image[lowest[1] + y, lowest[0] + x] = mixed


def _points(projected: np.ndarray) -> list[tuple[float, float]]:
    return [(x, y) for x, y in projected[:, :2].tolist()]


def _draw_skeleton(
    pen: ImageDraw.ImageDraw,
    motion: Figure,
    joints: np.ndarray,
    project: Callable[[np.ndarray], np.ndarray],
    rim: float,
) -> None:
    """Draws a figure with joints (J, 3) from back to front, with dark rims of `rim` pixels."""
    at, skeleton = project(joints), motion.skeleton
    thickness, side_of, top = radii(skeleton), sides(skeleton), head(skeleton)
    limbs = []
    for parent, joint in skeleton.edges:
        side = side_of[joint] if side_of[parent] == side_of[joint] else 0
        limbs.append((at[parent], at[joint], thickness[joint], side))
    if top is not None:
        up = joints[top] - joints[skeleton.parents[top]]
        up /= np.linalg.norm(up) or 1
        limbs.append((*project(joints[top] + np.array([[0.05], [0.11]]) * up), 0.085, 0))
    for a, b, radius, side in sorted(limbs, key=lambda limb: -limb[0][3] - limb[1][3]):
        if min(a[3], b[3]) > NEAR:
            _capsule(pen, a, b, radius, RIM_COLORS[side], rim)
            _capsule(pen, a, b, radius, SIDE_COLORS[side])


def _capsule(
    pen: ImageDraw.ImageDraw,
    a: np.ndarray,
    b: np.ndarray,
    radius: float,
    color: Color | int,
    grow: float = 0,
) -> None:
    """Draws a line with round ends; its radius is `radius` meters plus `grow` pixels."""
    (ax, ay, per_meter_a, *_), (bx, by, per_meter_b, *_) = a, b
    size_a, size_b = radius * per_meter_a + grow, radius * per_meter_b + grow
    pen.line([(ax, ay), (bx, by)], color, round(size_a + size_b))
    for x, y, size in ((ax, ay, size_a), (bx, by, size_b)):
        pen.ellipse((x - size, y - size, x + size, y + size), color)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(max(10, size // 18))


def _lines(motion: Figure, body: FittedBody | None, width: int, size: int) -> list[str]:
    """Returns up to three lines of the caption, and one more line if no body fits the motion."""
    lines, font = [""], _font(size)
    # The caption has room for three lines
    for word in shortened(motion.text or motion.id, width).split():
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) <= width - 16:
            lines[-1] = longer
        else:
            lines.append(word)
    lines = [line for line in lines if line]
    lines = [*lines[:2], f"{lines[2]} …"] if len(lines) > 3 else lines
    return lines if body else [*lines, "(no body fits)"]


def _caption(texts: Sequence[str], width: int, lines: int, size: int) -> Image.Image:
    """Draws each text on a separate line of an image that has room for `lines` lines."""
    line = round(max(10, size // 18) * 1.35)
    image = Image.new("RGB", (width, lines * line + 10), PAPER)
    pen = ImageDraw.Draw(image)
    for k, text in enumerate(texts):
        pen.text((8, 4 + k * line), text, TEXT, _font(size))
    return image


def _below(image: Image.Image, caption: Image.Image) -> Image.Image:
    taller = Image.new("RGB", (image.width, image.height + caption.height), PAPER)
    taller.paste(image)
    taller.paste(caption, (0, image.height))
    return taller
