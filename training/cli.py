"""The program `grasp`: runs one sub-command and tells errors in one line."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from grasp_env._extras import need
from grasp_env.errors import GraspError


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one sub-command.

    Returns:
        0; 2 after an error of the project, told in one line on stderr; 130 after an interrupt.
    """
    try:
        need("cli")
        from training.commands.program import parsed

        parsed(arguments).execute()
    except GraspError as error:
        sys.stderr.write(f"grasp: {error}\n")
        return 2
    except OSError as error:  # a disk that is full, a folder that is closed, a name too long: of whatever file
        from grasp_env._files import shown_path

        sys.stderr.write(f"grasp: {shown_path(error.filename)}: {error.strerror or error}; choose another path\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("grasp: interrupted\n")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
