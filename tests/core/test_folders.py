"""The folders of the C++ core look one way: math, contacts, Phi, its terms, the solvers, the
optimizer, and what stands on it."""

from __future__ import annotations

from docs.rooms import HEADERS, header_arrows

ROOMS: dict[str, set[str]] = {
    "version.hpp": set(),
    "detail": set(),
    "math": set(),
    "record.hpp": {"math"},
    "contacts": {"math", "record.hpp"},
    "phi": {"math", "contacts", "record.hpp"},
    "limits": {"math", "contacts", "phi"},
    "learned": {"detail", "math", "phi"},
    "conic": {"math", "phi", "limits"},
    "newton": {"phi", "limits", "conic"},
    "flow": {"phi", "newton"},
    "many": {"math", "conic", "newton"},
    "general": {"math", "contacts", "phi", "limits", "conic", "newton"},
    "problem.hpp": {"limits", "learned", "conic", "flow"},
    "optimizer": {
        "math",
        "record.hpp",
        "newton",
        "flow",
        "conic",
        "many",
        "general",
        "problem.hpp",
    },
    "optimizer.hpp": {"learned", "optimizer"},
    "layer": {"math", "contacts", "limits", "many", "optimizer.hpp"},
    "hand": {"detail", "math", "contacts", "phi", "problem.hpp", "optimizer.hpp"},
    "planner": {"hand"},
}
"""Folders and public headers of the core, the lowest first, and those that each includes.

Headers outside the folders are public.
"""


def _room(header: str) -> str:
    return header.split("/")[0]


def test_folders_look_one_way():
    order = list(ROOMS)
    for room, below in ROOMS.items():
        assert [other for other in below if order.index(other) >= order.index(room)] == [], room
    found = {room: set[str]() for room in ROOMS}
    for header, included in header_arrows().items():
        assert _room(header) in ROOMS, (
            f"{header} lies in no folder of the table: a private header belongs to a folder"
        )
        found[_room(header)] |= {_room(other) for other in included} - {_room(header)}
    assert {
        room: others - ROOMS[room] for room, others in found.items() if others - ROOMS[room]
    } == {}
    assert found == ROOMS, "an arrow that nothing needs any more"


def test_no_headers_include_each_other_in_a_circle():
    left = header_arrows()
    while free := [header for header, included in left.items() if not included & set(left)]:
        for header in free:
            del left[header]
    assert left == {}


LONGEST = 22_000
"""Largest number of characters of a header or a source file of the core."""


def test_no_file_is_long():
    core = HEADERS.parents[1]
    lengths = {path: path.stat().st_size for path in core.rglob("*.[ch]pp")}
    assert {str(path) for path, length in lengths.items() if length > LONGEST} == set()
