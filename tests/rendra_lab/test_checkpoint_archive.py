"""Checkpoints that are damaged, or were never meant well: told by name, nothing executed, nothing allocated."""

import collections
import io
import os
import pickle
import random
import resource
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rendra_lab.checkpoint_archive import FORMAT, CheckpointError, examine, read_checkpoint, write_checkpoint

STATE: dict[str, Any] = {
    "global_step": 7,
    "state_dict": collections.OrderedDict(weight=torch.arange(60.0).reshape(5, 12), bias=torch.ones(3)),
    "optimizer_states": [{"state": {0: {"step": torch.tensor(7.0)}}, "param_groups": [{"lr": 0.1, "params": [0]}]}],
    "rendra_lab": {"format": FORMAT, "task": "pose", "module": "rendra_lab.tasks.pose.Pose"},
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_checkpoint(tmp_path / "good.ckpt", STATE)
    return tmp_path / "good.ckpt"


def with_members(path: Path, change: Callable[[str, bytes], bytes], compression: int = zipfile.ZIP_STORED) -> None:
    """Writes the archive anew with changed members, and checksums that fit them."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, change(name, content))


def with_description(path: Path, description: bytes) -> None:
    with_members(path, lambda name, content: description if name.endswith("/data.pkl") else content)


def test_a_good_one_says_what_it_is_and_comes_back(path: Path) -> None:
    facts = examine(path)
    assert (facts.step, facts.task, facts.module) == (7, "pose", "rendra_lab.tasks.pose.Pose")
    back = read_checkpoint(path)
    assert torch.equal(back["state_dict"]["weight"], STATE["state_dict"]["weight"])
    assert back["rendra_lab"] == STATE["rendra_lab"]


def test_all_that_torch_reads_as_data_is_known(tmp_path: Path) -> None:
    shared = torch.arange(10.0)
    values = {
        "bytes": b"\x00\xff",
        "bytearray": bytearray(b"ab"),
        "set": {1, "two"},
        "complex": 1 - 2j,
        "numbers": (10**30, -(2**40), 0.5, True, None, "word"),
        "size": torch.Size([2, 3]),
        "device": torch.device("cpu"),
        "dtype": torch.bfloat16,
        "parameter": torch.nn.Parameter(torch.ones(2)),
        "sparse": torch.eye(3).to_sparse(),
        "expanded": torch.ones(1).expand(1000),
        "views": [shared[2:4], shared[::3]],
        "empty": torch.zeros(0, 4),
        "scalars": [torch.tensor(1, dtype=kind) for kind in (torch.int8, torch.uint16, torch.half, torch.complex64)],
    }
    write_checkpoint(tmp_path / "all.ckpt", {**STATE, "values": values})
    back = read_checkpoint(tmp_path / "all.ckpt")["values"]
    assert back["bytes"] == b"\x00\xff"
    assert torch.equal(back["views"][1], shared[::3])


def test_older_ones_without_words_about_themselves_are_read(tmp_path: Path) -> None:
    torch.save({"global_step": 3, "state_dict": {}}, tmp_path / "old.ckpt")
    facts = examine(tmp_path / "old.ckpt")
    assert (facts.step, facts.task, facts.module) == (3, None, None)
    assert read_checkpoint(tmp_path / "old.ckpt")["global_step"] == 3


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_what_is_cut_off_is_told(share: float, path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(CheckpointError, match=r"good.ckpt is (cut off|damaged: it is empty)"):
        read_checkpoint(path)


def test_a_flipped_byte_in_any_member_is_told(path: Path) -> None:
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if member.file_size]
        starts = {member.filename: content.index(archive.read(member), member.header_offset) for member in members}
    assert len(members) >= 7
    for member in members:
        for place in {0, member.file_size // 2, member.file_size - 1}:
            damaged = bytearray(content)
            damaged[starts[member.filename] + place] ^= 0x10
            path.write_bytes(damaged)
            with pytest.raises(CheckpointError, match=f"is damaged: {member.filename} fails its checksum"):
                read_checkpoint(path)


def test_a_flipped_byte_anywhere_is_told_or_harmless(path: Path) -> None:
    content, chance = path.read_bytes(), random.Random(3)
    for _ in range(400):
        damaged = bytearray(content)
        damaged[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            back = read_checkpoint(path)
        except CheckpointError:
            continue
        for name, tensor in STATE["state_dict"].items():  # padding between members, dates and the like
            assert torch.equal(back["state_dict"][name], tensor)


def test_what_is_no_checkpoint_is_told(tmp_path: Path) -> None:
    path = tmp_path / "other.ckpt"
    path.write_text("a letter")
    with pytest.raises(CheckpointError, match=r"other.ckpt is cut off, or is no checkpoint"):
        examine(path)
    torch.save({"a": 1}, path)
    with pytest.raises(CheckpointError, match="is no checkpoint of a run: it holds no state_dict"):
        examine(path)
    torch.save({"state_dict": {}, "global_step": "many"}, path)
    with pytest.raises(CheckpointError, match="does not say its step"):
        examine(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("photo.png", b"png")
    with pytest.raises(CheckpointError, match="is no checkpoint: its members are others"):
        examine(path)


def test_a_format_from_the_future_is_told(tmp_path: Path) -> None:
    path = tmp_path / "new.ckpt"
    torch.save({**STATE, "rendra_lab": {"format": FORMAT + 1}}, path)
    with pytest.raises(CheckpointError, match=f"format {FORMAT + 1}, newer than this program's {FORMAT}: update it"):
        examine(path)


class Planted:
    """Leaves a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


@pytest.mark.parametrize("place", ["top", "beside", "in the state", "plain pickle", "legacy"])
def test_a_planted_pickle_is_refused_and_not_run(place: str, tmp_path: Path) -> None:
    marker, path = tmp_path / "executed", tmp_path / "planted.ckpt"
    planted = Planted(marker)
    contents: dict[str, Any] = {
        "top": planted,
        "beside": {**STATE, "extra": planted},
        "in the state": {**STATE, "state_dict": {"weight": planted}},
    }
    if place == "plain pickle":
        path.write_bytes(pickle.dumps(planted))
    else:
        legacy = place == "legacy"
        torch.save(contents["top" if legacy else place], path, _use_new_zipfile_serialization=not legacy)
    for read in (examine, read_checkpoint):
        with pytest.raises(CheckpointError, match=r"asks for posix.mkdir, which could run code|is no checkpoint"):
            read(path)
    assert not marker.exists()


GLOBALS = {
    "bytearray": b"cbuiltins\nbytearray\n",
    "tensor": b"ctorch\nTensor\n",
    "storage": b"ctorch\nFloatStorage\n",
    "size": b"ctorch\nSize\n",
    "getattr": b"cbuiltins\ngetattr\n",
    "eval": b"c__builtin__\neval\n",
    "nested": b"ctorch._utils\n_rebuild_meta_tensor_no_storage\n",
    "load": b"ctorch\nload\n",
}
HUGE = b"\x8a\x05" + (10**11).to_bytes(5, "little")  # LONG1


@pytest.mark.parametrize("name", GLOBALS)
def test_no_call_makes_room_or_runs(name: str, path: Path) -> None:
    with_description(path, b"\x80\x02" + GLOBALS[name] + HUGE + b"\x85R.")
    with limited_memory(), pytest.raises(CheckpointError, match=r"refused|makes no sense|no checkpoint of a run"):
        read_checkpoint(path)


@pytest.mark.parametrize(
    "description",
    [
        b"\x80\x02" + HUGE + b"r\xff\xff\xff\x7f.",  # a memo of two thousand million places
        b"\x80\x02X\xff\xff\xff\x7fshort.",  # a string of 2 GB
        b"\x80\x05\x96" + struct.pack("<Q", 10**11) + b".",  # bytes of 100 GB
        b"\x80\x02}" + b"\x85" * 100_000 + b"K\x01s.",  # a key so deep that its hash ends the program
        b"\x80\x02h\x07.",  # refers to nothing
        b"\x80\x02",
        b"",
        b"\x80\x02}}a.",
        b"\x80\x02cbuiltins\nset\n)R}b.",
    ],
)
def test_descriptions_that_make_no_sense_are_told(description: bytes, path: Path) -> None:
    with_description(path, description)
    with limited_memory(), pytest.raises(CheckpointError):
        read_checkpoint(path)


@pytest.mark.parametrize("claim", [b"K\x3c", b"J\x00\x00\x00\x7f", HUGE])
def test_tensors_lie_inside_their_member(claim: bytes, path: Path) -> None:
    """The count of elements in the reference to the storage, 60, is replaced."""

    def change(name: str, content: bytes) -> bytes:
        if not name.endswith("/data.pkl"):
            return content
        assert content.count(b"K<tq") == 1
        return content.replace(b"K<tq", claim + b"tq")

    with_members(path, change)
    if claim == b"K\x3c":
        assert examine(path).step == 7
        return
    with limited_memory(), pytest.raises(CheckpointError, match="elements that member data/0 lacks"):
        read_checkpoint(path)


def test_a_bomb_is_refused_before_it_is_unpacked(path: Path) -> None:
    with_members(
        path, lambda name, content: bytes(1 << 26) if name.endswith("/data/0") else content, zipfile.ZIP_DEFLATED
    )
    assert path.stat().st_size < 100_000
    with limited_memory(), pytest.raises(CheckpointError, match="is compressed, which no checkpoint is"):
        read_checkpoint(path)


def test_a_kilobyte_that_claims_a_hundred_gigabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "claim.ckpt"
    entry, claimed = io.BytesIO(), 100 * 10**9
    with zipfile.ZipFile(entry, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps({}, protocol=2))
        member = archive.infolist()[0]
        member.file_size = member.compress_size = claimed
    path.write_bytes(entry.getvalue())
    assert path.stat().st_size < 1000
    with limited_memory(), pytest.raises(CheckpointError, match=f"claim {claimed:,} bytes"):
        read_checkpoint(path)


def test_members_that_share_their_bytes_are_refused(path: Path) -> None:
    """A thousand entries for the same bytes."""
    with zipfile.ZipFile(path, "a") as archive:
        member = max(archive.infolist(), key=lambda member: member.file_size)
        for index in range(1_000):
            twin = zipfile.ZipInfo(f"good/data/{1000 + index}")
            for name in ("header_offset", "file_size", "compress_size", "CRC"):
                setattr(twin, name, getattr(member, name))
            archive.filelist.append(twin)
        archive._didModify = True
    with pytest.raises(CheckpointError, match=r"its members claim [\d,]+ bytes, the file has"):
        read_checkpoint(path)


def test_what_two_readers_could_read_differently_is_refused(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(bytes(100) + content)
    with pytest.raises(CheckpointError, match="it holds several archives"):
        read_checkpoint(path)
    path.write_bytes(content)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(archive.namelist()[0].upper().replace("GOOD", "good").replace("ARCHIVE", "archive"), b"")
    with pytest.raises(CheckpointError, match="members of the same name"):
        read_checkpoint(path)


def test_a_member_marked_as_a_folder_is_refused(path: Path) -> None:
    """One flipped bit; torch would leave the memory of that tensor as it was."""
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        entry = content.index(b"PK\x01\x02", archive.start_dir)
        for member in archive.infolist():
            if member.filename.endswith("/data/0"):
                break
            entry = content.index(b"PK\x01\x02", entry + 4)
    content[entry + 38] ^= 0x10
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"/data/0 is marked as a folder"):
        read_checkpoint(path)


def test_a_tensor_repeated_without_end_is_refused(tmp_path: Path) -> None:
    torch.save({**STATE, "extra": torch.ones(1).expand(10**11)}, tmp_path / "wide.ckpt")
    with pytest.raises(CheckpointError, match="a tensor of 100,000,000,000 elements, repeated from 1"):
        examine(tmp_path / "wide.ckpt")


def test_what_nobody_could_read_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "kept.ckpt"
    write_checkpoint(path, STATE)
    with pytest.raises(CheckpointError, match=r"it asks for pathlib\S*, which could run code"):
        write_checkpoint(path, {**STATE, "extra": Path("x")})
    assert examine(path).step == 7
    assert list(tmp_path.iterdir()) == [path]


class limited_memory:
    """At most 500 MB more than what is mapped now."""

    def __enter__(self) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else None
        self.before = resource.getrlimit(resource.RLIMIT_AS)
        if pages is not None:
            room = pages * resource.getpagesize() + 500_000_000
            resource.setrlimit(resource.RLIMIT_AS, (room, self.before[1]))

    def __exit__(self, *_: object) -> None:
        resource.setrlimit(resource.RLIMIT_AS, self.before)
