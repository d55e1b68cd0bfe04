// The version of these headers: the same as the Python package's.
#pragma once

#define GRASP_VERSION "0.1.0"
