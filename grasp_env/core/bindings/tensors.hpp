// Tensors and arrays with any leading dimensions, read in place.
#pragma once

#include <algorithm>
#include <array>
#include <cstring>
#include <vector>

#include <grasp/layer/batch.hpp>
#include <nanobind/ndarray.h>

#include "module.hpp"

// `DLPackExchangeAPI` of DLPack 1 (dlpack.h): functions of a tensor type, in torch from 2.10 on.
struct ExchangeApi {
  std::uint32_t major, minor;
  void *previous_api, *allocator, *from_object, *to_object;
  // returns 0 on success; the object owns the viewed data
  int (*dltensor_from_object)(void* object, nb::dlpack::dltensor* to);
  void* current_stream;

  // Null: the object's type has no such functions.
  static const ExchangeApi* of(nb::handle object) {
    PyObject* const capsule = PyObject_GetAttrString(
        reinterpret_cast<PyObject*>(Py_TYPE(object.ptr())), "__dlpack_c_exchange_api__");
    // lives as long as the process
    void* const table = capsule ? PyCapsule_GetPointer(capsule, "dlpack_exchange_api") : nullptr;
    Py_XDECREF(capsule);
    if (!table) PyErr_Clear();
    const auto* const api = static_cast<const ExchangeApi*>(table);
    return api && api->major == 1 && api->dltensor_from_object ? api : nullptr;
  }
};

// A tensor or an array on the CPU, float64 or float32, or a number: a Python number, or a tensor
// without dimensions.
class Tensor {
 public:
  static constexpr int MOST_DIMENSIONS = 24;
  using Lengths = std::array<Py_ssize_t, MOST_DIMENSIONS>;
  struct Row {  // the shape of one problem's part: up to three lengths
    Py_ssize_t lengths[3];
    int dimensions;

    Row(Py_ssize_t first = 0, Py_ssize_t second = -1, Py_ssize_t third = -1)
        : lengths{first, second, third}, dimensions(1 + (second >= 0) + (third >= 0)) {}
    Py_ssize_t count() const {
      Py_ssize_t size = 1;
      for (int a = 0; a < dimensions; ++a) size *= lengths[a];
      return size;
    }
  };

  bool given = false, number = false, float32 = false;
  int dimensions = 0;
  Lengths shape{};

  Tensor() = default;
  Tensor(const Tensor&) = delete;
  Tensor& operator=(const Tensor&) = delete;
  ~Tensor() {
    if (held_) PyBuffer_Release(&buffer_);
  }

  // View an object, which must outlive the view; None counts as not given. Return false if it
  // cannot be read.
  bool view(nb::handle object) {
    if (object.is_none()) return true;
    given = true;
    if (PyFloat_CheckExact(object.ptr()) || PyLong_CheckExact(object.ptr())) {
      number = true;
      value_ = PyFloat_AsDouble(object.ptr());
      const bool good = !(value_ == -1.0 && PyErr_Occurred());
      if (!good) PyErr_Clear();
      return good;
    }
    if (!(PyObject_CheckBuffer(object.ptr()) ? view_buffer(object) : view_tensor(object)))
      return false;
    aligned_ =
        reinterpret_cast<std::uintptr_t>(data_) % (float32 ? sizeof(float) : sizeof(double)) == 0;
    if (dimensions == 0) {
      number = true;
      value_ = at(0);
    }
    return true;
  }
  Py_ssize_t from_last(int dimension) const { return shape[dimensions - dimension]; }
  int leading(const Row& row) const { return number ? 0 : dimensions - row.dimensions; }
  bool ends_in(const Row& row) const {
    return number || (leading(row) >= 0 &&
                      std::equal(row.lengths, row.lengths + row.dimensions, &shape[leading(row)]));
  }
  // Append a dimension along which all numbers are the same.
  bool repeat(Py_ssize_t times) {
    if (dimensions == MOST_DIMENSIONS) return false;
    shape[dimensions] = times;
    strides_[dimensions++] = 0;
    return true;
  }
  // Prepend leading dimensions of these lengths by broadcasting.
  void expand(const Row& row, const Lengths& lead, int leading) {
    Lengths strides{};
    const int own = this->leading(row);
    const int added = leading - own;
    for (int a = 0; a < leading; ++a)
      strides[a] = a < added || (shape[a - added] == 1 && lead[a] != 1) ? 0 : strides_[a - added];
    std::copy_n(&strides_[own], row.dimensions, &strides[leading]);
    strides_ = strides;
    dimensions = leading + row.dimensions;
    std::copy_n(lead.begin(), leading, shape.begin());
    std::copy_n(row.lengths, row.dimensions, &shape[leading]);
  }

  // `size` problems with a row each, or with one row for all; copied unless they can be read in
  // place.
  grasp::Slices slices(const Row& row, Py_ssize_t size) {
    const int first = leading(row);
    const Py_ssize_t per = row.count();
    if (number) {
      own_.assign(per, value_);
      return {own_.data(), 0};
    }
    if (!float32 && aligned_ && is_run(first, dimensions)) {
      if (first == 0 || size == 1) return {static_cast<const double*>(data_), 0};
      const Py_ssize_t step = strides_[first - 1];
      if (is_run(0, first, step)) return {static_cast<const double*>(data_), step};
    }
    own_.resize(first ? size * per : per);
    double* to = own_.data();
    copy(0, 0, to);
    return {own_.data(), first ? per : 0};
  }

 private:
  bool view_buffer(nb::handle object) {
    held_ = PyObject_GetBuffer(object.ptr(), &buffer_, PyBUF_STRIDES | PyBUF_FORMAT) == 0;
    if (!held_) PyErr_Clear();
    if (!held_ || buffer_.ndim >= MOST_DIMENSIONS) return false;
    float32 = std::strcmp(buffer_.format, "f") == 0;
    if (!float32 && std::strcmp(buffer_.format, "d") != 0) return false;
    dimensions = buffer_.ndim;
    data_ = buffer_.buf;
    for (int a = 0; a < dimensions; ++a) {
      if (buffer_.strides[a] % buffer_.itemsize != 0) return false;
      shape[a] = buffer_.shape[a];
      strides_[a] = buffer_.strides[a] / buffer_.itemsize;
    }
    return true;
  }
  bool view_tensor(nb::handle object) {
    const ExchangeApi* const api = ExchangeApi::of(object);
    nb::dlpack::dltensor tensor;
    if (!api || api->dltensor_from_object(object.ptr(), &tensor) != 0) {
      PyErr_Clear();
      return false;
    }
    constexpr int CPU = 1;
    float32 = tensor.dtype.bits == 32;
    if (tensor.device.device_type != CPU ||
        tensor.dtype.code != std::uint8_t(nb::dlpack::dtype_code::Float) ||
        tensor.dtype.lanes != 1 || (!float32 && tensor.dtype.bits != 64) || !tensor.data ||
        tensor.ndim >= MOST_DIMENSIONS || (tensor.ndim > 0 && !tensor.strides))
      return false;
    dimensions = tensor.ndim;
    data_ = static_cast<const char*>(tensor.data) + tensor.byte_offset;
    std::copy_n(tensor.shape, dimensions, shape.begin());
    std::copy_n(tensor.strides, dimensions, strides_.begin());
    return true;
  }
  // True if these dimensions are contiguous with the stride `step` in the last one; the stride of a
  // length of 1 does not matter.
  bool is_run(int from, int to, Py_ssize_t step = 1) const {
    for (int a = to - 1; a >= from; --a) {
      if (shape[a] != 1 && strides_[a] != step) return false;
      step *= shape[a];
    }
    return true;
  }
  double at(Py_ssize_t place) const {
    const auto read = [&](auto number) {
      std::memcpy(&number, static_cast<const char*>(data_) + place * Py_ssize_t(sizeof(number)),
                  sizeof(number));
      return double(number);
    };
    return float32 ? read(float()) : read(double());
  }
  void copy(int dimension, Py_ssize_t place, double*& to) const {
    for (Py_ssize_t k = 0; k < shape[dimension]; ++k, place += strides_[dimension]) {
      if (dimension + 1 < dimensions)
        copy(dimension + 1, place, to);
      else
        *to++ = at(place);
    }
  }

  Lengths strides_{};  // in numbers
  const void* data_ = nullptr;
  bool aligned_ = true;
  double value_ = 0.0;
  Py_buffer buffer_{};
  bool held_ = false;
  std::vector<double> own_;
};
