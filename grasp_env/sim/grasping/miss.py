"""The candidate that came nearest to a grasp, of a search that found none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from grasp_env.errors import InvalidInputError
from grasp_env.inputs.files import as_path
from grasp_env.sim.hand.description import HandDescription
from grasp_env.sim.objects.description import ObjectDescription


@dataclass(frozen=True)
class NearestMiss:
    """A hand near a grasp of an object, whose body frame is the world frame.

    `NoGraspError.nearest` has it.

    Attributes:
        hand: The hand at the place that was tried, with the fingers that were tried.
        item: The object.
        reached: Names of the fingers that find contacts on the object.

    Example:
        >>> from grasp_env.errors import NoGraspError
        >>> from grasp_env.sim import place_hand
        >>> smooth = ObjectDescription("capsule", (0.02, 0.2), friction=0.01)
        >>> try:
        ...     place_hand(HandDescription.three_finger(), smooth)
        ... except NoGraspError as error:
        ...     error.nearest.reached
        ('thumb', 'left', 'right')
    """

    hand: HandDescription
    item: ObjectDescription
    reached: tuple[str, ...]

    def draw(self, path: str | Path, size: int = 640) -> Path:
        """Save a picture of the hand and the object, from two sides, and return its path.

        The tips that find contacts are green, the other tips are red, and the object is yellow.

        Args:
            path: Path of the .png file. Missing folders are made.
            size: Height of the picture [pixels], 16 to 4096; it is twice as wide.

        Raises:
            InvalidInputError: The path or the size is not allowed.
            OSError: The file cannot be written.
        """
        from grasp_env.sim.picture.portrait import grasp_portrait, save_picture
        from grasp_env.sim.picture.view import picture_size

        picture_size(size)
        file = as_path(path, InvalidInputError, "the picture's file")
        if file.suffix.lower() != ".png":
            raise InvalidInputError(
                f"the picture's file must end with .png, got {str(file)!r}: draw({str(file.with_suffix('.png'))!r})"
            )
        file.parent.mkdir(parents=True, exist_ok=True)
        save_picture(grasp_portrait(self.hand, self.item, self.reached, size), file)
        return file
