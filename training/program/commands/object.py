"""`grasp object`: show or repair a mesh file, list or clear the cache of meshes."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.arguments import Array
from grasp_env.inputs.extras import need
from grasp_env.inputs.files import replacing
from training.program.commands.answers import make_table, write_json
from training.program.commands.options import left_out, misplaced

ACTIONS = {
    "show": ("file", "scale", "draw", "size"),
    "mend": ("file", "out"),
    "list": (),
    "clear": (),
}
"""Options that apply to some actions only."""
_NEAR = 1e-5  # share of the extent within which the centres of equal triangles lie


@dataclass(frozen=True)
class Object:
    """Show how a mesh is read, repair it, or list what is cached.

    `grasp object show mug.obj --draw mug.png`
    `grasp object mend torn.obj`
    `grasp object list`
    `grasp object clear`

    Attributes:
        what: show (how a mesh file is read), mend (repair a torn mesh by MeshFix and write it),
            list (the cached meshes and grasps) or clear (that cache).
        file: show and mend: a mesh, .obj, .stl, .ply, .off, .glb or .dae.
        scale: show: factor from the file's unit to metres, 0.001 for millimetres.
        draw: show: .png for a picture of the mesh beside its convex pieces, each in its own colour.
        size: show: height of the picture [pixels].
        out: mend: .obj file to write. It is overwritten if it exists.
        json: print one JSON object, errors too.
    """

    what: tyro.conf.Positional[Literal["show", "mend", "list", "clear"]]
    file: Annotated[
        Path | None, tyro.conf.Positional, left_out("list and clear need none", "FILE")
    ] = None
    scale: float = 1.0
    draw: Annotated[Path | None, left_out("no picture", "PICTURE.png")] = None
    size: int = 640
    out: Annotated[Path | None, left_out("beside FILE, its name with _mended.obj", "FILE")] = None
    json: bool = False

    def execute(self) -> None:
        """Run the command."""
        self._check()
        need("sim")
        actions = {"show": self._show, "mend": self._mend, "list": _list, "clear": _clear}
        facts, page = actions[self.what]()
        if self.json:
            write_json(facts)
            return
        console = Console()
        for item in page:
            is_text = isinstance(item, str)
            style = "yellow" if is_text and item.startswith(("repaired", "note")) else None
            console.print(item, style=style, highlight=False, soft_wrap=is_text)

    def _check(self) -> None:
        """Refuse a missing file, and options of another action."""
        if self.file is None and "file" in ACTIONS[self.what]:
            raise InvalidInputError(
                f"`grasp object {self.what}` needs a FILE: `grasp object {self.what} mug.obj`"
            )
        if option := misplaced(self, ACTIONS, self.what):
            name = f"FILE {self.file}" if option == "file" else f"--{option}"
            where = " and ".join(
                f"`grasp object {what}`" for what, names in ACTIONS.items() if option in names
            )
            raise InvalidInputError(
                f"{name} belongs to {where}, got `grasp object {self.what}`: leave it out"
            )

    def _show(self) -> tuple[dict[str, Any], list[Any]]:
        from grasp_env.settings import POSITIVE, real
        from grasp_env.sim.mesh_shape import scale_advice
        from grasp_env.sim.objects.cache import folder
        from grasp_env.sim.objects.description import GRASPABLE, check_extent
        from grasp_env.sim.objects.mesh import load_mesh, remarks
        from grasp_env.sim.picture.portrait import mesh_portrait, save_picture
        from grasp_env.sim.picture.view import picture_size

        picture_size(self.size)
        _check_suffix(self.draw, "--draw", ".png")
        mesh = load_mesh(str(self.file), real(POSITIVE).take(self.scale, "scale"), tell=False)
        fitting = scale_advice(max(mesh.extent) / self.scale, GRASPABLE)
        check_extent(mesh.extent, "mesh", f"give --scale {fitting or 'another number'}")
        if self.draw is not None:
            save_picture(mesh_portrait(mesh, self.size), self.draw)
        facts = {
            "file": self.file,
            "faces": len(mesh.faces),
            "extent": mesh.extent,
            "volume": mesh.volume,
            "center": mesh.center,
            "parts": mesh.parts,
            "pieces": len(mesh.pieces),
            "pieces_stand_out": mesh.excess.distance,
            "pieces_volume_share": mesh.excess.volume,
            "repaired": list(mesh.changes),
            "remarks": remarks(mesh),
            "kept_in": folder() if os.access(folder(), os.W_OK) else None,
            "picture": self.draw,
        }
        return facts, _shown_page(facts)

    def _mend(self) -> tuple[dict[str, Any], list[Any]]:
        from grasp_env.sim.mesh_shape import volume
        from grasp_env.sim.objects.reading import open_mesh, read_mesh
        from training.program.commands.mesh_repair import as_obj, repair_mesh

        assert self.file is not None
        out = self._out(self.file)
        name = f"the mesh {self.file}"
        before = read_mesh(open_mesh(self.file, name))
        mesh = repair_mesh(*before, name)
        with replacing(out) as path:
            path.write_bytes(as_obj(mesh, name))
        facts = {
            "file": self.file,
            "out": out,
            "faces_before": len(before[1]),
            "faces_after": len(mesh.faces),
            "faces_kept": _count_common(before[0][before[1]], mesh.corners[mesh.faces]),
            "parts": mesh.parts,
            "parts_left_out": mesh.left_out,
            "volume": volume(mesh.corners, mesh.faces),
            "changes": mesh.changes,
        }
        return facts, _repaired_page(facts)

    def _out(self, file: Path) -> Path:
        _check_suffix(self.out, "--out", ".obj")
        out = file.with_name(f"{file.stem}_mended.obj") if self.out is None else self.out
        if self.out is None and os.path.lexists(out):
            raise InvalidInputError(
                f"{out} exists: to overwrite it give --out {out}, or name another file"
            )
        return out


def _check_suffix(path: Path | None, option: str, suffix: str) -> None:
    if path is not None and path.suffix.lower() != suffix:
        raise InvalidInputError(
            f"{option} {path} must end in {suffix}, the only kind that is written"
        )


def _shown_page(facts: dict[str, Any]) -> list[Any]:
    table = make_table(facts["file"].name)
    table.add_row("faces", str(facts["faces"]))
    table.add_row("size, mm", " x ".join(f"{1e3 * side:.1f}" for side in facts["extent"]))
    table.add_row("volume, cm^3", f"{1e6 * facts['volume']:.4g}")
    table.add_row(
        "centre of mass in the file, mm",
        " ".join(f"{round(1e3 * value, 1) + 0.0:.1f}" for value in facts["center"]),
    )
    table.add_row("parts that are not connected", str(facts["parts"]))
    table.add_row("convex pieces", str(facts["pieces"]))
    table.add_row("they stand out by up to, mm", f"{1e3 * facts['pieces_stand_out']:.1f}")
    table.add_row("volume that they have more", f"{facts['pieces_volume_share']:.0%}")
    told = [f"repaired: {text}" for text in facts["repaired"]]
    told += [f"note: {text}" for text in facts["remarks"]]
    kept = "not kept: the cache folder cannot be written"
    if facts["kept_in"]:
        kept = f"kept in {facts['kept_in']}"
    picture = [] if facts["picture"] is None else [str(facts["picture"])]
    return [table, *told, kept, *picture]


def _repaired_page(facts: dict[str, Any]) -> list[Any]:
    table = make_table(facts["out"].name)
    table.add_row("faces in the file", str(facts["faces_before"]))
    table.add_row(
        "faces now", f"{facts['faces_after']}, {facts['faces_kept']} of them as in the file"
    )
    table.add_row("parts", str(facts["parts"]))
    if facts["parts_left_out"]:
        table.add_row("parts left out, as they enclose nothing", str(facts["parts_left_out"]))
    table.add_row("volume, in the file's unit", f"{facts['volume']:.6g}")
    changes = [f"repaired: {text}" for text in facts["changes"]]
    out = facts["out"]
    hint = f"look at it: grasp object show {out} --draw {out.with_suffix('.png')}"
    return [table, *changes, str(out), hint]


def _list() -> tuple[dict[str, Any], list[Any]]:
    from grasp_env.sim.objects.cache import entries, folder

    kept = []
    rows = []
    for entry in entries():
        pieces = _pieces(entry.path)
        facts = {"name": entry.name, "use": entry.use, "bytes": entry.size, "time": entry.time}
        kept.append({**facts, "pieces": pieces})
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(entry.time))
        rows.append((entry.name, entry.use, f"{entry.size / 1e3:.0f}", when, str(pieces or "")))
    title = f"{_counted(len(kept))}, {sum(facts['bytes'] for facts in kept) / 1e6:.1f} MB"
    table = make_table(title, "mesh or grasp", "use", "kB", "made", "convex pieces")
    for row in rows:
        table.add_row(*row)
    return {"folder": folder(), "entries": kept}, [table, f"in {folder()}"]


def _counted(entries: int) -> str:
    return f"{entries} {'entry' if entries == 1 else 'entries'}"


def _pieces(path: Path) -> int | None:
    """Return the number of convex pieces of a cache entry; None if it cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return len(arrays["counts"])
    except Exception:  # truncated, or not a cache entry
        return None


def _clear() -> tuple[dict[str, Any], list[Any]]:
    from grasp_env.sim.objects.cache import clear, folder

    count = clear()
    return {"folder": folder(), "removed": count}, [f"removed {_counted(count)} from {folder()}"]


def _count_common(before: Array, after: Array) -> int:
    """Return the number of triangles (F, 3, 3) `after` with a centre among those `before`."""
    grain = _NEAR * float(np.ptp(before.reshape(-1, 3), axis=0).max())
    known, kept = (
        set(map(tuple, np.round(triangles.mean(axis=1) / grain).astype(np.int64).tolist()))
        for triangles in (before, after)
    )
    return len(known & kept)
