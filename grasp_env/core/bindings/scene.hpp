// Shared by the files of scenes and of the control loop.
#pragma once

#include <nanobind/ndarray.h>

#include <grasp/hand/snapshot.hpp>

#include "buffers.hpp"

using Arrays = nb::typed<nb::dict, nb::str, nb::ndarray<>>;

// Views of a snapshot by name, which keep its owner alive.
Arrays arrays_of(nb::handle owner, grasp::Snapshot& snapshot);
