// The solvers, compiled once for this module and for that of the tests.
#include <grasp/compiled_engine.hpp>
