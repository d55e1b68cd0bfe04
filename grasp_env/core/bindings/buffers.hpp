// Python's buffer protocol: an array is read in place if its layout is the core's. Otherwise Python
// converts it, or reports an error.
#pragma once

#include <cstring>
#include <span>

#include "module.hpp"

class Buffer {
 public:
  Buffer(nb::handle object, bool writable = false) {
    if (object.is_none() || !PyObject_CheckBuffer(object.ptr())) return;
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0);
    held_ = PyObject_GetBuffer(object.ptr(), &view_, flags) == 0;
    if (!held_) PyErr_Clear();
  }
  ~Buffer() {
    if (held_) PyBuffer_Release(&view_);
  }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;

  // True for float64 numbers of this shape; -1: any length.
  template <class... Sizes> bool has(Sizes... sizes) const {
    const Py_ssize_t expected[] = {Py_ssize_t(sizes)...};
    if (!held_ || std::strcmp(view_.format, "d") != 0 || view_.ndim != int(sizeof...(sizes)))
      return false;
    for (int a = 0; a < view_.ndim; ++a)
      if (expected[a] >= 0 && view_.shape[a] != expected[a]) return false;
    return true;
  }
  // True for `count` float64 numbers in any shape.
  bool holds(Py_ssize_t count) const {
    return held_ && std::strcmp(view_.format, "d") == 0 &&
           view_.len == count * Py_ssize_t(sizeof(double));
  }
  Py_ssize_t length(int axis) const { return view_.shape[axis]; }
  double* data() const { return static_cast<double*>(view_.buf); }
  std::span<double> numbers() const { return {data(), view_.len / sizeof(double)}; }

 private:
  Py_buffer view_;
  bool held_ = false;
};

// The numbers of an array that the package made for the core. Throws a TypeError for another shape.
class Numbers : public Buffer {
 public:
  template <class... Sizes> Numbers(nb::handle object, bool writable, Sizes... sizes)
      : Buffer(object, writable) {
    if (!has(sizes...))
      throw nb::type_error("expected a C-contiguous float64 array of another shape");
  }
};
template <class... Sizes> inline Numbers in(nb::handle object, Sizes... sizes) {
  return {object, false, sizes...};
}
template <class... Sizes> inline Numbers out(nb::handle object, Sizes... sizes) {
  return {object, true, sizes...};
}

// Throw a ValueError unless index is one of `size`.
inline void check_index(int index, std::size_t size, const char* message) {
  if (index < 0 || std::size_t(index) >= size) throw nb::value_error(message);
}

// Rows of numbers with any leading dimensions, or a TypeError as above.
class NumberRows : public Buffer {
 public:
  // optional: None has null rows
  NumberRows(nb::handle object, bool writable, Py_ssize_t count, Py_ssize_t row,
             bool optional = false)
      : Buffer(object, writable), row_(row), none_(optional && object.is_none()) {
    if (!none_ && !holds(count * row))
      throw nb::type_error("expected C-contiguous float64 numbers of another shape");
  }
  double* operator[](Py_ssize_t k) const { return none_ ? nullptr : data() + k * row_; }

 private:
  Py_ssize_t row_;
  bool none_;
};
