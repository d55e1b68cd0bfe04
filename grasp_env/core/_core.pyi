"""The compiled core; `grasp_env.core` is its door."""



def build_info() -> dict[str, str]:
    """
    Version, compiler, instruction set, build type and flags of this module.
    """
