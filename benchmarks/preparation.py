"""Speed and memory of `make prepare` at several sizes: `python benchmarks/preparation.py [frames ...]`.

For each size, a fresh process prepares synthetic clips of about 51 frames in a temporary folder (1.1 KB of disk per
frame), with one worker per core. Gives the processor time of all processes together, the maximum resident memory of the
process and of its largest worker, of each the part that is not shared with other processes (sampled), and by how many
bytes the process grows per frame.
"""

import multiprocessing
import resource
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from sections import Row, Section, section, show

FRAMES_PER_CLIP = 51
MEBIBYTE = 2**20


def private(process: int) -> int:
    """Returns the bytes of memory that a process shares with no other."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:  # it has ended
        return 0
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))


def prepare(clips: int) -> None:
    """Prepares clips; prints frames, seconds of processor time, and resident and private bytes of main and worker."""
    from flame_mdm.data.store import write_store
    from flame_mdm.data.synthetic import Synthetic
    from flame_mdm.representations.humanml import HumanML

    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    peaks, done = [0, 0], threading.Event()

    def spent() -> float:
        return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, kinds))

    def watch() -> None:
        while not done.wait(0.5):
            workers = (private(child.pid or 0) for child in multiprocessing.active_children())
            peaks[:] = max(peaks[0], private(multiprocessing.current_process().pid or 0)), max(peaks[1], *workers, 0)

    threading.Thread(target=watch, daemon=True).start()
    with tempfile.TemporaryDirectory() as folder:
        start = spent()
        store = write_store(Path(folder, "store"), Synthetic(clips), HumanML())
        seconds = spent() - start
        frames = store.info["shape"][0]
    done.set()
    resident = [1024 * resource.getrusage(kind).ru_maxrss for kind in kinds]
    print(frames, seconds, *resident, *peaks)


def measure(*words: str) -> Section:
    """Measures the numbers of frames in `words`."""
    rows: list[Row] = []
    points, rates = [], []
    for size in [int(word) for word in words] or [250_000, 1_000_000]:
        clips = max(size // FRAMES_PER_CLIP, 1)
        line = [sys.executable, __file__, "--clips", str(clips)]
        values = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, text=True).stdout
        frames, seconds, *memory = map(float, values.split())
        names = ("main process, MiB", "worker, MiB", "private to main, MiB", "private to worker, MiB")
        sizes = {name: part / MEBIBYTE for name, part in zip(names, memory, strict=True)}
        rates.append(clips / seconds)
        rows.append({"frames": frames, "processor seconds": seconds, "clips per second and core": rates[-1], **sizes})
        points.append((frames, memory[0]))
    (few, small), (many, large) = points[0], points[-1]
    growth = (large - small) / (many - few) if many > few else 0
    return section(
        "Preparation of a data set",
        f"`make prepare` with synthetic clips of about {FRAMES_PER_CLIP} frames, one worker per core. Seconds are "
        "those of all processes together, in processor time. Memory is the maximum during the run.",
        f"One core prepares {rates[-1]:,.0f} clips per second; the memory grows by {growth:.0f} bytes per frame.",
        sizes=rows,
    )


if __name__ == "__main__":
    if "--clips" in sys.argv:
        prepare(int(sys.argv[-1]))
    else:
        show(measure(*sys.argv[1:]))
