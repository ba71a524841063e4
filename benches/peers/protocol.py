"""The protocol of the scripts of this folder, which is that of the Rust benches: two calls that are not counted, then the median."""

import os
import resource
import statistics
import sys
import time

ALLOCATOR = "glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=100000000000"

if "GLIBC_TUNABLES" not in os.environ:
    # Without it, the system maps the memory of large tensors anew in each step.
    os.environ["GLIBC_TUNABLES"] = ALLOCATOR
    os.execv(sys.executable, [sys.executable] + sys.argv)

import torch  # noqa: E402: after the allocator is set


def options(parser):
    """Adds the options of all scripts, reads the arguments, and sets the number of threads."""
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--repeats", type=int, default=15)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    return args


def measure(name, args, how, forward, step):
    """Prints the times of `forward()` without gradients and of `step()`, in milliseconds, and the peak memory."""

    def times(f):
        result = []
        for _ in range(args.repeats + 2):
            start = time.perf_counter()
            f()
            result.append(1e3 * (time.perf_counter() - start))
        return result[2:]

    with torch.no_grad():
        values = times(forward)
    steps = times(step)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(
        f"{name}, PyTorch {torch.__version__}, {how}, {args.threads} threads: median {statistics.median(steps):.1f} ms, least {min(steps):.1f} ms, "
        f"forward {statistics.median(values):.1f} ms, {memory} MB"
    )
