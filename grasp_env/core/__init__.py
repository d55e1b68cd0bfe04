"""The compiled core, C++20: headers in `include/grasp`, this module their door to Python."""

try:
    from grasp_env.core._core import (
        ACCEPTED_GAP,
        LARGEST,
        NOTHING,
        ROUNDING,
        TANGENT_SWITCH,
        UNIT_TOLERANCE,
        Conic,
        Contacts,
        Newton,
        Pipeline,
        Solution,
        all_finite,
        build_info,
        codes,
        combine,
        grasp_arrays,
        normalise,
        record_fields,
        record_size,
        solve_scaled,
    )
except ImportError as error:
    raise ImportError(
        f"grasp_env.core._core is not built for this Python ({error}): run `make install` or `pip install .`"
    ) from error

__all__ = [
    "ACCEPTED_GAP",
    "LARGEST",
    "NOTHING",
    "ROUNDING",
    "TANGENT_SWITCH",
    "UNIT_TOLERANCE",
    "Conic",
    "Contacts",
    "Newton",
    "Pipeline",
    "Solution",
    "all_finite",
    "build_info",
    "codes",
    "combine",
    "grasp_arrays",
    "normalise",
    "record_fields",
    "record_size",
    "solve_scaled",
]
