"""Limits of jobs are found wherever schedulers and containers put them."""

import pytest

from tasks.job_limits import usable_cores, usable_memory_bytes

GB = 1 << 30


def written(root, files):
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    return root / "cgroup", root / "membership"


CASES = {
    "v2 of a container, whose group is the root": (
        "0::/",
        {"memory.max": 3 * GB, "cpu.max": "50000 100000"},
    ),
    "v2 of a SLURM job: its group lies four levels down": (
        "0::/system.slice/slurmstepd.scope/job_7/step_0",
        {
            "system.slice/slurmstepd.scope/job_7/step_0/memory.max": "max",
            "system.slice/slurmstepd.scope/job_7/memory.max": 3 * GB,
            "system.slice/slurmstepd.scope/job_7/cpu.max": "100000 100000",
            "system.slice/memory.max": 5 * GB,
            "system.slice/cpu.max": "max 100000",
        },
    ),
    "v2 of a systemd slice: the smallest limit is that of an ancestor": (
        "0::/user.slice/user-1000.slice/session.scope",
        {
            "user.slice/user-1000.slice/session.scope/memory.max": 8 * GB,
            "user.slice/memory.max": 3 * GB,
            "user.slice/cpu.max": "20000 100000",
        },
    ),
    "v1 of a SLURM job, a hierarchy for each controller": (
        "5:memory:/slurm/uid_0/job_7\n3:cpu,cpuacct:/slurm/uid_0/job_7\n0::/init.scope",
        {
            "memory/slurm/uid_0/job_7/memory.limit_in_bytes": 3 * GB,
            "memory/memory.limit_in_bytes": 9223372036854771712,
            "cpu,cpuacct/slurm/uid_0/job_7/cpu.cfs_quota_us": 50000,
            "cpu,cpuacct/slurm/uid_0/job_7/cpu.cfs_period_us": 100000,
            "cpu,cpuacct/cpu.cfs_quota_us": -1,
            "cpu,cpuacct/cpu.cfs_period_us": 100000,
        },
    ),
    "v1 of a container without a name space of its own: the path is the host's": (
        "5:memory:/docker/0123/job\n3:cpu:/docker/0123/job\n",
        {
            "memory/job/memory.limit_in_bytes": 4 * GB,
            "memory/memory.limit_in_bytes": 3 * GB,
            "cpu/cpu.cfs_quota_us": 100000,
            "cpu/cpu.cfs_period_us": 100000,
        },
    ),
    "v1 shown to a process that names no hierarchy": (
        "0::/../../elsewhere",
        {
            "memory/memory.limit_in_bytes": 3 * GB,
            "cpu/cpu.cfs_quota_us": 50000,
            "cpu/cpu.cfs_period_us": 100000,
        },
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_the_smallest_limit_above_a_process_counts(tmp_path, case):
    membership, files = CASES[case]
    files = {f"cgroup/{name}": text for name, text in files.items()}
    places = written(tmp_path, {**files, "membership": membership})
    assert usable_memory_bytes(*places) == 3 * GB
    assert usable_cores(*places) == 1


@pytest.mark.parametrize("files", [{}, {"membership": "nonsense\n::\n0::/a:b"}])
def test_without_a_limit_the_machine_counts(tmp_path, files):
    places = written(tmp_path, files)
    assert usable_memory_bytes(*places) >= usable_memory_bytes() > 0
    assert usable_cores(*places) >= usable_cores() >= 1


@pytest.mark.parametrize("text", ["max", "", "-5", "many", "0"])
def test_what_is_no_limit_limits_nothing(tmp_path, text):
    names = ("memory.max", "memory/memory.limit_in_bytes", "cpu.max", "cpu/cpu.cfs_quota_us")
    places = written(tmp_path, {f"cgroup/{name}": text for name in names})
    nowhere = (tmp_path / "absent", tmp_path / "absent")
    assert usable_memory_bytes(*places) == usable_memory_bytes(*nowhere)
    assert usable_cores(*places) == usable_cores(*nowhere)
