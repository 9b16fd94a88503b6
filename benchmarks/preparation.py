"""Speed and memory of `make prepare` at several sizes: `python benchmarks/preparation.py [frames ...]`.

For each size, a fresh process prepares synthetic clips of about 51 frames in a temporary folder (1.1 KB of disk per
frame), with one worker per core. Prints the maximum resident memory of the process and of its largest worker, of each
the part that is not shared with other processes (sampled), and by how many bytes the process grows per frame.
"""

import multiprocessing
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from tqdm import tqdm

FRAMES_PER_CLIP = 51
MEBIBYTE = 2**20


def private(process: int) -> int:
    """Returns the bytes of memory that a process shares with no other."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:  # it has ended
        return 0
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))


def measure(clips: int) -> None:
    """Prepares clips and prints frames, seconds, and bytes: resident and private, of this process and of a worker."""
    from flame_mdm.data.store import write_store
    from flame_mdm.data.synthetic import Synthetic
    from flame_mdm.representations.humanml import HumanML

    peaks, done = [0, 0], threading.Event()

    def watch() -> None:
        while not done.wait(0.5):
            workers = (private(child.pid or 0) for child in multiprocessing.active_children())
            peaks[:] = max(peaks[0], private(multiprocessing.current_process().pid or 0)), max(peaks[1], *workers, 0)

    threading.Thread(target=watch, daemon=True).start()
    tqdm.monitor_interval = 0
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        store = write_store(Path(folder, "store"), Synthetic(clips), HumanML())
        seconds = time.perf_counter() - start
        frames = store.info["shape"][0]
    done.set()
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    resident = [1024 * resource.getrusage(kind).ru_maxrss for kind in kinds]
    print(frames, seconds, *resident, *peaks)


def main(sizes: list[int]) -> None:
    print(f"{'frames':>10}{'clips':>8}{'seconds':>9}{'frames/s':>10}{'clips/s':>9}{'main, MiB':>16}{'worker, MiB':>16}")
    print(f"{'':>46}{'max':>8}{'private':>8}{'max':>8}{'private':>8}")
    points = []
    for size in sizes:
        clips = max(size // FRAMES_PER_CLIP, 1)
        line = [sys.executable, __file__, "--clips", str(clips)]
        values = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, text=True).stdout
        frames, seconds, main, worker, main_private, worker_private = map(float, values.split())
        memory = "".join(f"{part / MEBIBYTE:>8.0f}" for part in (main, main_private, worker, worker_private))
        print(f"{frames:>10,.0f}{clips:>8,}{seconds:>9.1f}{frames / seconds:>10,.0f}{clips / seconds:>9,.0f}{memory}")
        points.append((frames, main))
    (few, small), (many, large) = points[0], points[-1]
    if many > few:
        print(f"growth of the main process: {(large - small) / (many - few):.0f} bytes per frame")


if __name__ == "__main__":
    if "--clips" in sys.argv:
        measure(int(sys.argv[-1]))
    else:
        main([int(frames) for frames in sys.argv[1:]] or [250_000, 1_000_000])
