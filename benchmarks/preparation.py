"""Measures the speed and memory use of `make prepare` for several data set sizes: `python benchmarks/preparation.py`.

For each size, a new process prepares synthetic clips of about 51 frames in a temporary folder (1.1
KB of disk space per frame), with one worker per core. The script reports the total CPU time of all
processes, and the maximum resident memory of the main process and of the largest worker. It also
reports their private memory, which is not shared with other processes and is sampled at intervals,
and the number of bytes per frame by which the main process grows.
"""

import json
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from sections import Row, Section, Settings, section, show

FRAMES_PER_CLIP = 51
MEBIBYTE = 2**20
MEMORY = ("main process, MiB", "worker, MiB", "private to main, MiB", "private to worker, MiB")


def private(process: int) -> int:
    """Returns the private memory of a process in bytes, or 0 if it has ended or /proc is missing."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Private_"))


class Peaks(threading.Thread):
    """A thread that tracks the maximum private memory, in bytes, of this process and of any of its workers."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.main, self.worker = 0, 0
        self.done = threading.Event()

    def run(self) -> None:
        """Samples the memory of this process and of its children every half second until `done` is set."""
        while not self.done.wait(0.5):
            workers = [private(child.pid or 0) for child in multiprocessing.active_children()]
            self.main = max(self.main, private(multiprocessing.current_process().pid or 0))
            self.worker = max(self.worker, *workers, 0)


def prepare(clips: int) -> None:
    """Prepares clips in this process, and prints the number of frames, CPU seconds and bytes of memory as JSON."""
    from flame_mdm.data.store import write_store
    from flame_mdm.data.synthetic import Synthetic
    from flame_mdm.representations.humanml import HumanML

    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)

    def spent() -> float:
        return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, kinds))

    peaks = Peaks()
    peaks.start()
    with tempfile.TemporaryDirectory() as folder:
        start = spent()
        store = write_store(Path(folder, "store"), Synthetic(clips), HumanML())
        seconds = spent() - start
        frames = store.info["shape"][0]
    peaks.done.set()

    resident = [1024 * resource.getrusage(kind).ru_maxrss for kind in kinds]
    print(json.dumps([frames, seconds, *resident, peaks.main, peaks.worker]))


def measure(settings: Settings) -> Section:
    """Measures the time and memory that the preparation of large data sets takes, and returns the page section."""
    rows: list[Row] = []
    growth: list[tuple[float, float]] = []
    for size in [2000] if settings.quick else [100_000, 200_000]:
        clips = size // FRAMES_PER_CLIP
        command = [sys.executable, __file__, "--clips", str(clips)]
        finished = subprocess.run(command, capture_output=True, text=True, check=False)
        if finished.returncode:
            raise SystemExit(finished.stderr)

        frames, seconds, *memory = json.loads(finished.stdout.splitlines()[-1])
        row: Row = {
            "frames": frames,
            "CPU seconds": seconds,
            "clips per second per core": clips / seconds,
        }
        rows.append(
            row | {name: part / MEBIBYTE for name, part in zip(MEMORY, memory, strict=True)}
        )
        growth.append((frames, memory[0]))

    (few, small), (many, large) = growth[0], growth[-1]
    per_frame = (large - small) / (many - few) if many > few else 0
    return section(
        "Data set preparation",
        f"""`make prepare` converts synthetic clips of about {FRAMES_PER_CLIP} frames, with one worker per core. Times
        are CPU seconds, summed over all processes. Memory is the peak during the run.""",
        f"One core prepares {rows[-1]['clips per second per core']:,.0f} clips per second, and memory grows by "
        f"{per_frame:.0f} bytes per frame.",
        {"sizes": rows},
    )


if __name__ == "__main__":
    if "--clips" in sys.argv:
        prepare(int(sys.argv[-1]))
    else:
        show(measure(Settings()))
