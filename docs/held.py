"""Draws the picture of docs/objects.md: a row for each mesh, a column for each hand, after four
seconds of a random wrench.

python -m docs.held --hands four_finger allegro leap --objects FILE[=SCALE]... --out
docs/static/held.webp
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from grasp_env.env.env import FourFingerGrasp
from grasp_env.inputs.files import replacing
from grasp_env.sim.picture.camera import Camera, CameraConfig
from training.data.episodes import episode
from training.evaluation.compare.scenarios import PUSHES, mesh_settings, short_name

SIDE = 300
"""Side of a picture [pixels]."""
HEAD = 34
"""Height of a line of names [pixels]."""


def tile(hand: str, text: str, seed: int = 0) -> Image.Image:
    """Draw the hand and the object of FILE[=SCALE] at the end of an episode, and mark a lost
    object.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # repairs of the mesh
        env = FourFingerGrasp("rgb_array", hand=hand, **mesh_settings(text)[1], **PUSHES["random"])
    try:
        info = [step.info for step in episode(env, seed)][-1]
        config = CameraConfig(
            SIDE, SIDE, margin=0.03, footer=0.03, object_opacity=1.0, supersampling=2
        )
        picture = Image.fromarray(Camera(env.scene, config).capture())
    finally:
        env.close()
    if not info["is_success"]:
        ImageDraw.Draw(picture).text(
            (10, 10), f"not held: {info['fault']}", "#c03020", ImageFont.load_default(18)
        )
    return picture


def sheet(hands: Sequence[str], objects: Sequence[str]) -> Image.Image:
    """All of them with their names; objects in two blocks side by side."""
    half = (len(objects) + 1) // 2
    font = ImageFont.load_default(20)
    block = len(hands) * SIDE
    out = Image.new("RGB", (2 * block + 20, half * (SIDE + HEAD) + HEAD), "white")
    draw = ImageDraw.Draw(out)
    for number, text in enumerate(objects):
        left = (number // half) * (block + 20)
        top = HEAD + (number % half) * (SIDE + HEAD)
        draw.text((left + 8, top + 5), mesh_settings(text)[0], "black", font)
        for column, hand in enumerate(hands):
            if number % half == 0:
                draw.text(
                    (left + column * SIDE + 8, 5),
                    short_name(hand).replace("_", " "),
                    "#555555",
                    font,
                )
            out.paste(tile(hand, text), (left + column * SIDE, top + HEAD))
    return out


def main(words: Sequence[str] | None = None) -> None:
    """Draws the sheet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hands", nargs="+", default=["four_finger", "allegro", "leap"])
    parser.add_argument(
        "--objects", nargs="+", required=True, help="mesh files, each FILE or FILE=SCALE"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/static/held.webp"))
    options = parser.parse_args(words)
    picture = sheet(options.hands, options.objects)
    with replacing(options.out) as hidden:
        picture.save(hidden, quality=82)
    print(
        f"{options.out}: {np.array(picture).shape[1]} x {np.array(picture).shape[0]} pixels, {options.out.stat().st_size // 1000} kB"
    )


if __name__ == "__main__":
    main()
