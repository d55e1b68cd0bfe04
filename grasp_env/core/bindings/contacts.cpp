// Contact geometry: the arrays of a `Grasp`, and the contacts for solvers.
#include <grasp/contacts/contacts.hpp>

#include "buffers.hpp"
#include "views.hpp"

using namespace grasp;

namespace {

// Index of the first tangent parallel to its unit normal; -1: none.
int first_along(int count, const double* tangents, const double* normals) {
  constexpr double LEAST = 1e-6;  // sine of the angle between them
  for (int i = 0; i < count; ++i) {
    const Point n = point(normals + 3 * i);
    const Point o = point(tangents + 3 * i);
    if (!(length(o - dot(o, n) * n) > LEAST * length(o))) return i;
  }
  return -1;
}
int along_normal(nb::handle tangents, nb::handle normals) {
  const Numbers o = in(tangents, -1, 3);
  const Numbers n = in(normals, o.length(0), 3);
  return first_along(int(o.length(0)), o.data(), n.data());
}

// Reads the arguments of `Grasp.from_contacts`: arrays of the core's layout, numbers within the
// ranges of `grasp_env/inputs/ranges.py`, a rank of 6 beyond doubt. Python treats all others.
struct ContactReader {
  double least_friction, most_friction, least_length, most_length, distance;
  int most;
  PyTypeObject* array;  // numpy's own class: subclasses may hold masks

  nb::object read(nb::handle positions, nb::handle normals, nb::handle friction,
                  nb::handle tangents) const {
    const bool turned = !tangents.is_none();
    if (!plain(positions) || !plain(normals) || (turned && !plain(tangents))) return nb::none();
    const Buffer at(positions);
    const Buffer inward(normals);
    const Buffer along(tangents);
    if (!at.has(-1, 3) || at.length(0) > most) return nb::none();
    const int count = int(at.length(0));
    if (!inward.has(count, 3) || (turned && !along.has(count, 3))) return nb::none();
    const auto placed = [&](std::span<const double> mu) {
      return place(Contacts(count, mu, {}, turned ? along.data() : nullptr), mu, at.data(),
                   inward.data());
    };
    if (PyFloat_Check(friction.ptr())) return placed(std::array{PyFloat_AsDouble(friction.ptr())});
    if (!plain(friction)) return nb::none();
    const Buffer mu(friction);
    if (mu.has(count)) return placed(std::span(mu.data(), count));
    return mu.has(count, 2) ? placed(std::span(mu.data(), 2 * count)) : nb::none();
  }

 private:
  bool plain(nb::handle object) const { return Py_TYPE(object.ptr()) == array; }

  nb::object place(Contacts&& c, std::span<const double> friction, const double* at,
                   const double* inward) const {
    for (const double mu : friction)
      if (!(mu >= least_friction && mu <= most_friction)) return nb::none();
    if (c.place(at, inward) != Placing::good || !c.clear) return nb::none();
    const double size = c.unit.length;
    if (!(size >= least_length && size <= most_length && length(c.unit.centre) <= distance * size))
      return nb::none();
    if (!c.tangents.empty() && first_along(c.count, c.tangents.data(), c.normals.data()) >= 0)
      return nb::none();
    return nb::cast(std::move(c));
  }
};

bool all_finite(nb::handle array) {
  Py_buffer view;
  if (PyObject_GetBuffer(array.ptr(), &view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) != 0)
    throw nb::python_error();
  const bool good = std::strcmp(view.format, "d") == 0;
  double total = 0.0;
  if (good)
    for (Py_ssize_t k = 0; k < view.len / 8; ++k)
      total += 0.0 * static_cast<const double*>(view.buf)[k];
  PyBuffer_Release(&view);
  if (!good) throw nb::type_error("expected a C-contiguous float64 array");
  return total == 0.0;
}

int normalise(nb::handle normals) {
  const Numbers n = out(normals, -1, 3);
  int first = -1;
  for (int i = int(n.length(0)) - 1; i >= 0; --i) {
    const Point normal = point(n.data() + 3 * i);
    const Point unit = normalised(normal);
    if (!(std::abs(length(normal) - 1.0) <= UNIT_TOLERANCE)) first = i;
    for (int a = 0; a < 3; ++a) n.data()[3 * i + a] = unit[a];
  }
  return first;
}

void scales(nb::handle friction, nb::handle scale) {
  const Numbers mu = in(friction, -1, 2);
  const Numbers cones = out(scale, mu.length(0), 3);
  for (Py_ssize_t i = 0; i < mu.length(0); ++i) {
    const Point row = cone_scale(mu.data()[2 * i], mu.data()[2 * i + 1]);
    for (int a = 0; a < 3; ++a) cones.data()[3 * i + a] = row[a];
  }
}

Contacts make(nb::handle positions, nb::handle normals, nb::handle scale, nb::handle weights,
              nb::handle tangents) {
  const Numbers p = in(positions, -1, 3);
  const int count = int(p.length(0));
  const Numbers n = in(normals, count, 3);
  const Numbers s = in(scale, count, 3);
  const Numbers w = in(weights, count, 2);
  const Numbers along = in(tangents, -1, 3);
  return Contacts::checked(count, p.data(), n.data(), s.data(), w.data(),
                           along.length(0) ? in(tangents, count, 3).data() : nullptr);
}

Contacts put(nb::handle positions, nb::handle normals, nb::handle scale, nb::handle torsion,
             nb::handle tangents) {
  const Numbers p = in(positions, -1, 3);
  const int count = int(p.length(0));
  const Numbers n = in(normals, count, 3);
  const Numbers s = in(scale, count, 3);
  const Numbers gamma = in(torsion, count);
  const Numbers along = in(tangents, -1, 3);
  const std::vector<double> weights(2 * count, 1.0);
  Contacts contacts(count, s.data(), weights.data(),
                    along.length(0) ? in(tangents, count, 3).data() : nullptr, gamma.data());
  contacts.set_weights(Objective{});
  if (contacts.place(p.data(), n.data()) == Placing::refused)
    contacts.unit = UnitFrame(p.data(), count);  // for their size
  return contacts;
}

// Copies for solvers, with the current directions of o.
template <class Weights> Contacts weighed(const Contacts& contacts, const Weights& weights) {
  if (contacts.placing != Placing::good) throw nb::value_error("rank(G) < 6");
  Contacts copy = contacts;
  copy.keep_tangents();
  copy.set_weights(weights);
  if (!copy.weights_good()) throw nb::value_error("weights must be finite and > 0");
  return copy;
}
Contacts weighed_alike(const Contacts& contacts, double force_weight, double barrier_weight) {
  return weighed(contacts, Objective{force_weight, barrier_weight});
}
Contacts weighed_each(const Contacts& contacts, nb::handle weights) {
  return weighed(contacts, in(weights, contacts.count, 2).data());
}

const Contacts& of(nb::handle self) { return nb::cast<const Contacts&>(self); }
// A view of an array with a row, or three columns, for each contact.
template <std::vector<double> Contacts::* array, std::size_t... columns>
ReadOnly rows(nb::handle self) {
  return view(self, (of(self).*array).data(), {std::size_t(of(self).count), columns...});
}
template <std::vector<double> Contacts::* matrix> ReadOnly columns(nb::handle self) {
  return view(self, (of(self).*matrix).data(), {6, std::size_t(3 * of(self).count)});
}

ReadOnly cone_matrix(const Contacts& c) {
  std::vector<double> matrix = c.matrix;
  for (std::size_t k = 0; k < matrix.size(); ++k) matrix[k] /= c.divisor[k % (3 * c.count)];
  return array_of(std::move(matrix), {6, std::size_t(3 * c.count)});
}
ReadOnly torsion_matrix(const Contacts& c) {
  const std::size_t n = c.count;
  std::vector<double> matrix(6 * n);
  for (std::size_t i = 0; i < n; ++i)
    for (int a = 0; a < 3 && c.torsion[i] > 0.0; ++a)
      matrix[(3 + a) * n + i] = c.normals[3 * i + a];
  return array_of(std::move(matrix), {6, n});
}
ReadOnly unit_frame(const Contacts& c) {
  std::vector<double> matrix(36);
  c.unit.write(matrix.data());
  return array_of(std::move(matrix), {6, 6});
}

}  // namespace

void bind_contacts(nb::module_& m) {
  m.attr("TANGENT_SWITCH") = TANGENT_SWITCH;
  m.attr("ROUNDING") = ROUNDING;
  m.attr("LARGEST") = LARGEST;
  m.attr("NOTHING") = NOTHING;
  m.def("all_finite", &all_finite, "array"_a,
        "True if all numbers of a C-contiguous float64 array are finite.");
  m.def("normalise", &normalise, "normals"_a,
        "Normalise (N, 3) directions in place. Return the first index off unit length by more than "
        "1 %; -1: none.");
  m.def("along_normal", &along_normal, "tangents"_a, "normals"_a,
        "Return the index of the first of (N, 3) tangents parallel to its unit normal; -1: none.");
  m.def("cone_scale", &scales, "friction"_a, "scale"_a,
        "Fill `scale` (N, 3), cone coordinates = scale * force, from friction (N, 2) along o and "
        "t; 0: frictionless.");
  nb::class_<ContactReader>(m, "ContactReader",
                            "Fast reader for the arguments of `Grasp.from_contacts`.")
      .def(
          "__init__",
          [](ContactReader* self, double least_friction, double most_friction, double least_length,
             double most_length, double distance, int most) {
            auto* array = reinterpret_cast<PyTypeObject*>(
                nb::module_::import_("numpy").attr("ndarray").ptr());
            new (self) ContactReader{least_friction, most_friction, least_length, most_length,
                                     distance,       most,          array};
          },
          nb::kw_only(), "least_friction"_a, "most_friction"_a, "least_length"_a, "most_length"_a,
          "distance"_a, "most"_a,
          "Accepted ranges of friction and length of a grasp [m], distance of its origin in "
          "lengths, number of contacts.")
      .def("read", &ContactReader::read, "positions"_a.none(), "normals"_a.none(),
           "friction"_a.none(), "tangents"_a.none(),
           nb::sig("def read(self, positions: object, normals: object, friction: object, tangents: "
                   "object) -> Contacts | None"),
           "Make hard contacts from float64 arrays: (N, 3), friction a float, (N,) or (N, 2), "
           "tangents (N, 3) or None.\n"
           "Return None if one has another class, shape or layout or is out of range, or if the "
           "rank is not 6 beyond doubt.");
  nb::class_<Contacts>(m, "Contacts",
                       "Contacts: friction, weights and places. The arrays are those of a `Grasp`.")
      .def_static("make", &make, "positions"_a, "normals"_a, "scale"_a, "weights"_a, "tangents"_a,
                  "Make hard contacts: (N, 3) positions [m], inward unit normals and scale of cone "
                  "coordinates, (N, 2) omega and\n"
                  "lambda, (N, 3) tangents or (0, 3). Raises ValueError for unusable numbers.")
      .def_static(
          "put", &put, "positions"_a, "normals"_a, "scale"_a, "torsion"_a, "tangents"_a,
          "The same with (N,) torsional friction [m]; the caller checks `refused` and `clear`.")
      .def("weighed", &weighed_alike, "force_weight"_a, "barrier_weight"_a,
           "Copy for solvers with omega and lambda, keeping the current tangents. Raises "
           "ValueError unless the rank of G is 6.")
      .def("weighed", &weighed_each, "weights"_a, "The same with (N, 2) omega and lambda.")
      .def_ro("count", &Contacts::count, "Number of contacts.")
      .def_prop_ro(
          "refused", [](const Contacts& c) { return c.placing == Placing::refused; },
          "True if numbers are not finite, positions all at one point or normals not of unit "
          "length.")
      .def_ro("clear", &Contacts::clear, "True if the rank is 6 beyond doubt, torsion included.")
      .def(
          "within_reach",
          [](const Contacts& c, nb::handle wrench, nb::handle to) {
            const Vec6 part = c.within_reach(in(wrench, 6).data());
            std::ranges::copy(part, out(to, 6).data());
          },
          "wrench"_a, "to"_a,
          "Write the part of a wrench (6,) that forces of these contacts can make into `to` (6,).")
      .def_prop_ro(
          "rank", [](const Contacts& c) { return c.reach.rank; }, "Rank of G, torsion included.")
      .def_prop_ro("soft", &Contacts::soft, "True if any contact transmits torsion.")
      .def_prop_ro("length", [](const Contacts& c) { return c.unit.length; })
      .def_prop_ro("centre", [](nb::handle s) { return view(s, &of(s).unit.centre.u, {3}); })
      .def_prop_ro("positions", &rows<&Contacts::positions, 3>)
      .def_prop_ro("normals", &rows<&Contacts::normals, 3>)
      .def_prop_ro(
          "tangents",
          [](nb::handle s) {
            return view(s, of(s).tangents.data(), {of(s).tangents.size() / 3, 3});
          },
          "(N, 3) given tangents, or (0, 3) for the default rule.")
      .def_prop_ro("frames", &rows<&Contacts::frames, 3, 3>)
      .def_prop_ro("matrix", &columns<&Contacts::matrix>)
      .def_prop_ro("cone_matrix", &cone_matrix, nb::rv_policy::automatic)
      .def_prop_ro("torsion_matrix", &torsion_matrix, nb::rv_policy::automatic)
      .def_prop_ro("unit_frame", &unit_frame, nb::rv_policy::automatic);
}
