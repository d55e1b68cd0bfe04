"""The compiled core, C++20: headers in `include/grasp`, this module their door to Python."""

try:
    from grasp_env.core._core import build_info
except ImportError as error:
    raise ImportError(
        f"grasp_env.core._core is not built for this Python ({error}): run `make install` or `pip install .`"
    ) from error

__all__ = ["build_info"]
