// Arrays of numpy, and of others by Python's buffer protocol: an array is read in place if its
// layout is the core's. Otherwise Python converts it, or reports an error.
#pragma once

#include <cstring>
#include <span>

#include "module.hpp"

#define NPY_NO_DEPRECATED_API NPY_2_0_API_VERSION
#include <numpy/ndarraytypes.h>

class Buffer {
 public:
  // The type of numpy arrays, which are read without the protocol: it takes as long as a small
  // calculation. Set when the module is loaded.
  inline static PyTypeObject* array_type = nullptr;

  Buffer(nb::handle object, bool writable = false) {
    if (object.is_none()) return;
    if (Py_TYPE(object.ptr()) == array_type)
      read_array(reinterpret_cast<PyArrayObject*>(object.ptr()), writable);
    else if (PyObject_CheckBuffer(object.ptr()))
      read_buffer(object.ptr(), writable);
  }
  ~Buffer() {
    if (held_) PyBuffer_Release(&view_);
  }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;

  // True for float64 numbers of this shape; -1: any length.
  template <class... Sizes> bool has(Sizes... sizes) const {
    const Py_ssize_t expected[] = {Py_ssize_t(sizes)...};
    if (dimensions_ != int(sizeof...(sizes))) return false;
    for (int a = 0; a < dimensions_; ++a)
      if (expected[a] >= 0 && shape_[a] != expected[a]) return false;
    return true;
  }
  // True for `count` float64 numbers in any shape.
  bool holds(Py_ssize_t count) const { return dimensions_ >= 0 && count_ == count; }
  Py_ssize_t length(int axis) const { return shape_[axis]; }
  double* data() const { return data_; }
  std::span<double> numbers() const { return {data_, std::size_t(count_)}; }

 private:
  Py_buffer view_;
  bool held_ = false;
  double* data_ = nullptr;
  const Py_ssize_t* shape_ = nullptr;
  int dimensions_ = -1;  // of float64 numbers; -1: there are none
  Py_ssize_t count_ = 0;

  void read_buffer(PyObject* object, bool writable) {
    const int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0);
    held_ = PyObject_GetBuffer(object, &view_, flags) == 0;
    if (!held_) PyErr_Clear();
    if (!held_ || std::strcmp(view_.format, "d") != 0) return;
    data_ = static_cast<double*>(view_.buf);
    shape_ = view_.shape;
    dimensions_ = view_.ndim;
    count_ = view_.len / Py_ssize_t(sizeof(double));
  }
  void read_array(PyArrayObject* array, bool writable) {
    const int flags = writable ? NPY_ARRAY_CARRAY : NPY_ARRAY_CARRAY_RO;
    if (PyArray_TYPE(array) != NPY_DOUBLE || !PyArray_CHKFLAGS(array, flags) ||
        !PyArray_ISNOTSWAPPED(array))
      return;
    data_ = static_cast<double*>(PyArray_DATA(array));
    shape_ = PyArray_DIMS(array);
    dimensions_ = PyArray_NDIM(array);
    count_ = 1;
    for (int a = 0; a < dimensions_; ++a) count_ *= shape_[a];
  }
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
