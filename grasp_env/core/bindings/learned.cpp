// Trained models.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <grasp/learned/model_file.hpp>

#include "buffers.hpp"

using namespace grasp;

namespace {

std::vector<float> singles(const Numbers& from) {
  std::vector<float> out(from.numbers().begin(), from.numbers().end());
  for (const float v : out)
    if (!(std::abs(v) <= std::numeric_limits<float>::max()))
      throw nb::value_error("weights must be finite in float32");
  return out;
}

Network make_network(const std::vector<int>& sizes, nb::handle weights) {
  const size_t count = Network::numbers(sizes);
  if (!count)
    throw nb::value_error(
        "a network must have 1 to MOST_STAGES stages, each with 1 to WIDEST numbers");
  return Network(sizes, singles(in(weights, count)).data());
}

Model make_model(const Network& network, const Network& pairs) {
  Model model;
  model.network = network;
  model.pairs = pairs;
  if (!model.whole())
    throw nb::value_error(
        "pairs must have one stage, 6 to 2 M numbers, and the network PLAIN_FEATURES + M inputs");
  return model;
}

void normalise(Model& model, double floor, double smoothing, double log_mean, double log_scale,
               double friction_mean, double friction_scale) {
  model.normalisation = {floor, smoothing, log_mean, log_scale, friction_mean, friction_scale};
  if (!model.normalisation.good())
    throw nb::value_error("means must be finite, lengths and scales also > 0");
}

void place(Model& model, nb::handle null_space, double friction, double scale, double largest) {
  const Numbers columns = in(null_space, -1, -1);
  model.null_space.assign(columns.numbers().begin(), columns.numbers().end());
  model.friction = friction;
  model.scale = scale;
  model.largest = largest;
}

nb::bytes save(const Model& model) {
  const std::string bytes = ModelFile::write(model);
  return nb::bytes(bytes.data(), bytes.size());
}

Vec6 vector(nb::handle wrench) {
  Vec6 w;
  std::copy_n(in(wrench, 6).data(), 6, w.begin());
  return w;
}

bool covers(const Model& model, nb::handle wrench) { return model.covers(vector(wrench)); }

void predict(Model& model, nb::handle wrench, nb::handle coordinates) {
  model.predict(vector(wrench), out(coordinates, model.network.outputs()).numbers());
}

}  // namespace

void bind_learned(nb::module_& m) {
  m.attr("PLAIN_FEATURES") = PLAIN_FEATURES;
  m.attr("MOST_STAGES") = MOST_STAGES;
  m.attr("WIDEST") = WIDEST;
  nb::class_<Network>(m, "Network",
                      "A float32 perceptron with activation v/2 (1 + v / sqrt(1 + v^2)).")
      .def_static("make", &make_network, "sizes"_a, "weights"_a,
                  "sizes: inputs, hidden ..., outputs; weights: for each stage the matrix (inputs "
                  "x outputs), then its bias, flat.");
  nb::class_<Model>(m, "Model", "A trained model for given contacts.")
      .def_static("make", &make_model, "network"_a, "pairs"_a,
                  "pairs: one stage that maps a wrench's direction to vectors, whose lengths are "
                  "further inputs of the network.")
      .def("normalise", &normalise, "floor"_a, "smoothing"_a, "log_mean"_a, "log_scale"_a,
           "friction_mean"_a, "friction_scale"_a,
           "Set the scaling of the network's features, see policies/features.py.")
      .def("place", &place, "null_space"_a, "friction"_a, "scale"_a, "largest"_a,
           "Set the contacts. null_space: (3N, 3N - 6) internal forces, the basis of the network's "
           "outputs; scale:\n"
           "sqrt(lambda / omega) relative to that of training; largest: size of the largest "
           "training wrench [N],\n"
           "< 0: none is covered.")
      .def("save", &save,
           "Return the bytes of a model file, which `grasp::ModelFile` reads in C++.")
      .def_static(
          "load", [](nb::bytes bytes) { return ModelFile::read({bytes.c_str(), bytes.size()}); },
          "bytes"_a, "Return the model that `save` wrote; None if the bytes are not a whole file.")
      .def("covers", &covers, "wrench"_a,
           "True if the wrench (unit frame), contacts and friction lie in the training range.")
      .def("predict", &predict, "wrench"_a, "coordinates"_a,
           "Predict the internal force for a wrench (unit frame), as coordinates (3N - 6,) [N] in "
           "the null space.");
}
