// Trained models and their starts.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <grasp/learned/model_file.hpp>
#include <grasp/solvers.hpp>

#include "following.hpp"
#include "timing.hpp"

using namespace grasp;
using namespace grasp::generic;

namespace {

// Weights are kept as float32; here they come as the float64 of every other array.
std::vector<float> singles(const Numbers& from, size_t count) {
    std::vector<float> out(from.data(), from.data() + count);
    for (const float v : out)
        if (!(std::abs(v) <= std::numeric_limits<float>::max())) throw nb::value_error("weights must be finite in float32");
    return out;
}

Network make_network(const std::vector<int>& sizes, nb::handle weights) {
    const size_t count = Network::numbers(sizes);
    if (!count) throw nb::value_error("a network has 1 to MOST_STAGES stages, each of 1 to WIDEST numbers");
    return Network(sizes, singles(in(weights, count), count).data());
}

Model make_model(const Network& network) {
    Model model;
    model.network = network;
    return model;
}

void normalise(Model& model, double length, double floor, double log_mean, double log_scale, double friction_mean,
               double friction_scale) {
    model.normalisation = {length, floor, log_mean, log_scale, friction_mean, friction_scale};
    if (!model.normalisation.good()) throw nb::value_error("means must be finite, lengths and scales also > 0");
}

void place(Model& model, nb::handle null_space, double friction, double scale, double largest) {
    const Numbers columns = in(null_space, -1, -1);
    model.null_space.assign(columns.data(), columns.data() + columns.length(0) * columns.length(1));
    model.friction = friction, model.scale = scale, model.largest = largest;
}

nb::bytes save(const Model& model) {
    const std::string bytes = ModelFile::write(model);
    return nb::bytes(bytes.data(), bytes.size());
}

std::unique_ptr<Learned> make(const Contacts& contacts, double tolerance, int limit, nb::handle basis, const Model& model) {
    if (!model.fits(contacts.count)) throw nb::value_error("the model's network or null space is for other contacts");
    return Learned::make(contacts, {tolerance, limit}, in(basis, 13, 3 * contacts.count).data(), model);
}

// From the combination or the network, or from the force of a previous record where that is better. REFUSED where the wrench is
// no (6,) float64 array of finite numbers, or the previous record is of other contacts.
template <Code (Learned::*run)(const double*, const double*, double*)>
int called(Learned& learned, nb::handle wrench, nb::handle previous, nb::handle record) {
    const int count = learned.contacts.count, size = record_size(count);
    const Buffer load(wrench);
    const Numbers row = out(record, size);
    if (!load.has(6)) return REFUSED;
    if (previous.is_none()) return (learned.*run)(load.data(), nullptr, row.data());
    const Buffer before(previous);
    return before.has(size) ? (learned.*run)(load.data(), Record(before.data(), count).force(), row.data()) : REFUSED;
}

bool predict(Learned& learned, nb::handle wrench, nb::handle force) {
    return learned.predict(in(wrench, 6).data(), out(force, learned.contacts.count, 3).data());
}

void times(Learned& learned, nb::handle wrenches, int passes, nb::handle records, nb::handle best) {
    time_calls(wrenches, passes, record_size(learned.contacts.count), records, best,
               [&](const double* wrench, double* row) { learned.solve(wrench, nullptr, row); });
}

}  // namespace

void bind_learned(nb::module_& m) {
    m.attr("NETWORK_FEATURES") = NETWORK_FEATURES, m.attr("MOST_STAGES") = MOST_STAGES, m.attr("WIDEST") = WIDEST;
    nb::class_<Network>(m, "Network", "A float32 perceptron with activation v/2 (1 + v / sqrt(1 + v^2)).")
        .def_static("make", &make_network, "sizes"_a, "weights"_a,
                    "sizes: inputs, hidden ..., outputs; weights: of each stage (inputs x outputs), then its bias, flat.");
    nb::class_<Model>(m, "Model", "A trained model on contacts as they are now.")
        .def_static("make", &make_model, "network"_a)
        .def("normalise", &normalise, "length"_a, "floor"_a, "log_mean"_a, "log_scale"_a, "friction_mean"_a, "friction_scale"_a,
             "Of the network's features, see policies/features.py.")
        .def("place", &place, "null_space"_a, "friction"_a, "scale"_a, "largest"_a,
             "null_space: (3N, 3N - 6) internal forces that the network's outputs stand for; scale: sqrt(lambda / omega) over "
             "that of\n"
             "training; largest: size of the training's wrenches [N], < 0: none is covered.")
        .def("save", &save, "What `grasp::ModelFile` reads: one file for C++ programs.")
        .def_static(
            "load", [](nb::bytes bytes) { return ModelFile::read({bytes.c_str(), bytes.size()}); }, "bytes"_a,
            "The model that `save` wrote; None: it is not whole.");
    nb::class_<Learned>(m, "Learned", "A trained model's starts on the hard contacts of one grasp, and Newton from them.")
        .def_static("make", &make, "contacts"_a, "tolerance"_a, "limit"_a, "basis"_a, "model"_a,
                    "basis: (13, 3N) the offline optima, cone coordinates.")
        .def("start", &called<&Learned::start>, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "The start into a record; returns `limit`, for a descent has to go on from it.\n"
             "previous: the record of another wrench's optimum, or None.")
        .def("solve", &called<&Learned::solve>, "wrench"_a.none(), "previous"_a.none(), "record"_a,
             "The start, and Newton from it, into a record; returns the code.")
        .def("predict", &predict, "wrench"_a, "force"_a,
             "The network's own force (N, 3) [N], perhaps outside the cones. False: not finite.")
        .def("solve_many", &solve_many<Learned>, "wrenches"_a, "previous"_a.none(), "records"_a, SOLVE_MANY)
        .def("times", &times, "wrenches"_a, "passes"_a, "records"_a, "best"_a, "Best seconds of `passes` solves each, into (M,).")
        .def(
            "covers", [](const Learned& learned, nb::handle wrench) { return learned.covers(in(wrench, 6).data()); }, "wrench"_a,
            "Whether wrench, contacts and friction lie in the training range.")
        .def_prop_ro("outside", &Learned::outside, "Whether the last wrench was not covered.")
        .def_prop_ro("replaced", &Learned::replaced,
                     "Whether nothing of the last prediction was kept: the combination was taken.");
}
