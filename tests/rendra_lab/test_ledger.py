"""The ledger of a sweep: nothing torn, nothing claimed twice, the dead are noticed."""

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rendra_lab import ledger as module
from rendra_lab.errors import UserError
from rendra_lab.ledger import JobState, Ledger
from rendra_lab.sweep_job import SweepOptions, job_key


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    return Ledger(tmp_path / "sweep", stale_s=0.3, heartbeat_s=0.05)


def queued(ledger: Ledger, *keys: str) -> list[JobState]:
    return ledger.enqueue([(key, [f"x={key}"]) for key in keys], lambda number, overrides: f"{number}_{overrides[0]}")


def test_a_job_is_its_settings_however_they_are_written() -> None:
    key = job_key(["a.lr=0.001", "b='x'", "task=pose"])
    assert key == job_key(["task=pose", 'b="x"', "a.lr=1e-3"])
    assert key == job_key(
        ["task=pose", "b=x", "a.lr=1e-3", "sweep.retries=3", "output_root=/there", "hydra.verbose=1"]
    )
    assert key == job_key(["a.lr=0.1", "task=pose", "b=x", "a.lr=1e-3"])  # the last one counts
    others = [["a.lr=0.002", "b=x", "task=pose"], ["a.lr=1e-3", "task=pose"], ["a.lr=1e-3", "b=null", "task=pose"]]
    assert len({key, *map(job_key, others)}) == 4
    assert job_key(["s='0.1'"]) != job_key(["s=0.1"])
    assert job_key(["d={a: 1, b: [x, 'y']}"]) == job_key(["d={b: ['x', y], a: 1}"])
    assert job_key(["s=1,2"]) == job_key(["s=choice(1, 2)"]) != job_key(["s=1,3"])


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"retries": -1}, "sweep.retries must be a whole number from 0 on, got -1"),
        ({"retries": "often"}, "got 'often'"),
        ({"fresh": 1}, "sweep.fresh must be true or false, got 1"),
        ({"at_once": 0}, "sweep.at_once must be a whole number from 1 on"),
        ({"heartbeat_s": "x"}, "sweep.heartbeat_s must be a positive number of seconds, got 'x'"),
        ({"stale_s": 15}, "sweep.stale_s=15 must be twice"),
    ],
)
def test_options_that_cannot_be_are_refused(option: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        SweepOptions(**option)


def test_a_torn_line_costs_only_itself(ledger: Ledger) -> None:
    (job,) = queued(ledger, "aa")
    with ledger.path.open("a") as file:
        file.write('{"event": "done", "job": "aa", "va')
    assert ledger.states()["aa"].status == "queued"
    ledger.append("failed", job=job.key, claim=1, error="why")
    assert ledger.states()["aa"].status == "failed"
    assert ledger.states()["aa"].error == "why"
    assert [event["event"] for event in ledger.events()] == ["queued", "failed"]
    ledger.append("done", job=job.key, claim=2, value=1.5, metrics={"psnr": 3.0})
    ledger.append("interrupted", job=job.key, claim=3)  # whoever comes late changes nothing
    state = ledger.states()["aa"]
    assert (state.status, state.value, state.metrics, state.ended) == ("done", 1.5, {"psnr": 3.0}, {1, 2, 3})


def test_many_processes_write_whole_lines(ledger: Ledger) -> None:
    code = "import sys, pathlib; from rendra_lab.ledger import Ledger; ledger = Ledger(pathlib.Path(sys.argv[1]))\n"
    code += "for i in range(40): ledger.append('x', writer=sys.argv[2], text='y' * 500)"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(ledger.folder), str(i)]) for i in range(3)]
    assert [writer.wait(timeout=60) for writer in writers] == [0, 0, 0]
    lines = ledger.path.read_text().splitlines()
    assert len(lines) == len(ledger.events()) == 120
    assert {json.loads(line)["writer"] for line in lines} == {"0", "1", "2"}


def test_jobs_keep_their_number_and_never_share_a_folder(ledger: Ledger) -> None:
    (ledger.folder / "1_x=bb").mkdir(parents=True)
    first = queued(ledger, "aa", "bb", "aa")
    assert [job.folder for job in first] == ["0_x=aa", "1_x=bb-bb", "0_x=aa"]
    again = queued(ledger, "cc", "bb")
    assert [(job.number, job.folder) for job in again] == [(2, "2_x=cc"), (1, "1_x=bb-bb")]
    (twin,) = ledger.enqueue([("dd", ["x=dd"])], lambda number, overrides: "2_x=cc")
    assert twin.folder == "2_x=cc-dd"


def test_only_one_of_many_gets_a_claim(ledger: Ledger) -> None:
    (job,) = queued(ledger, "aa")
    with ThreadPoolExecutor(8) as pool:
        claims = [claim for claim in pool.map(lambda _: ledger.claim(job, 0), range(16)) if claim is not None]
    (claim,) = claims
    with claim:
        assert ledger.free_after(ledger.states()["aa"]) is None
        claim.tell("failed", error="x")
    assert ledger.free_after(ledger.states()["aa"]) == 1


def test_a_dead_process_holds_nothing(ledger: Ledger) -> None:
    (job,) = queued(ledger, "aa")
    code = "import os, signal, sys, pathlib; from rendra_lab.ledger import Ledger\n"
    code += "ledger = Ledger(pathlib.Path(sys.argv[1])); ledger.claim(ledger.states()['aa'], 0)\n"
    code += "print(flush=True); signal.pause()"
    process = subprocess.Popen([sys.executable, "-c", code, str(ledger.folder)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    assert ledger.free_after(job) is None
    process.kill()
    deadline = time.monotonic() + 10
    while ledger.free_after(job) is None and time.monotonic() < deadline:  # a zombie until it is waited for
        time.sleep(0.01)
    assert ledger.free_after(job) == 1
    process.wait()
    process.stdout.close()
    assert ledger.free_after(job) == 1


def test_another_machine_is_believed_while_its_heart_beats(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    (job,) = queued(ledger, "aa")
    claim = ledger.claim(job, 0)
    assert claim is not None
    monkeypatch.setattr(module, "_machine", lambda: "another")
    path = ledger.folder / ".claims" / "aa.1"
    os.utime(path, (0, 0))  # the clocks of files are not consulted
    with claim:
        for _ in range(8):
            assert ledger.free_after(job) is None
            time.sleep(0.1)
    assert ledger.free_after(job) is None
    time.sleep(0.4)
    assert ledger.free_after(job) == 1


def test_who_was_asleep_for_too_long_stops(ledger: Ledger) -> None:
    (job,) = queued(ledger, "aa")
    claim = ledger.claim(job, 0)
    assert claim is not None
    thief = None
    try:
        thief = ledger.claim(job, 1)
        with pytest.raises(KeyboardInterrupt):
            time.sleep(5)
    finally:
        for held in (claim, thief):
            if held is not None:
                held.__exit__()
    assert claim.lost
    assert thief is not None
    assert not thief.lost


def test_a_machine_without_processes_in_files_believes_heartbeats(
    ledger: Ledger, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_started", lambda pid: None)
    (job,) = queued(ledger, "aa")
    claim = ledger.claim(job, 0)
    assert claim is not None
    claim.__exit__()
    assert ledger.free_after(job) is None
    time.sleep(0.4)
    assert ledger.free_after(job) == 1
