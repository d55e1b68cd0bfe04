// Tensors and arrays of any leading dimensions, read where their numbers lie.
#pragma once

#include <array>
#include <vector>

#include <grasp/layer/batch.hpp>
#include <nanobind/ndarray.h>

#include "buffers.hpp"

// DLPack's table of functions, which torch has from 2.10 on: the type's attribute `__dlpack_c_exchange_api__`. Without it Python gives arrays.
struct ExchangeApi {
    std::uint32_t major, minor;
    void* before;
    void* others[3];
    int (*view)(void* object, nb::dlpack::dltensor* to);  // 0: done; the object keeps what is viewed
    void* stream;

    static const ExchangeApi* of(nb::handle object) {
        PyObject* const capsule =
            PyObject_GetAttrString(reinterpret_cast<PyObject*>(Py_TYPE(object.ptr())), "__dlpack_c_exchange_api__");
        void* const found = capsule ? PyCapsule_GetPointer(capsule, "dlpack_exchange_api") : nullptr;  // as long as the process
        Py_XDECREF(capsule);
        if (!found) PyErr_Clear();
        const auto* const api = static_cast<const ExchangeApi*>(found);
        return api && api->major == 1 && api->view ? api : nullptr;
    }
};

// A tensor or an array on the CPU, float64 or float32, or a number.
class Tensor {
public:
    struct Row {  // the shape of a problem's own numbers, without the zeros
        Py_ssize_t sizes[3];
        int axes() const { return 1 + (sizes[1] > 0) + (sizes[2] > 0); }
        Py_ssize_t count() const { return sizes[0] * std::max<Py_ssize_t>(sizes[1], 1) * std::max<Py_ssize_t>(sizes[2], 1); }
    };
    static constexpr int MOST_AXES = 24;

    bool given = false, number = false, single = false;  // single: float32
    int axes = 0;
    std::array<Py_ssize_t, MOST_AXES> shape{};

    Tensor() = default;
    Tensor(const Tensor&) = delete;
    Tensor& operator=(const Tensor&) = delete;
    ~Tensor() {
        if (held_) PyBuffer_Release(&buffer_);
    }

    // False: it cannot be read. None is nothing given. The object must outlive what is read.
    bool view(nb::handle object) {
        if (object.is_none()) return true;
        given = true;
        if (PyFloat_CheckExact(object.ptr()) || PyLong_CheckExact(object.ptr())) {
            number = true, value_ = PyFloat_AsDouble(object.ptr());
            const bool good = !(value_ == -1.0 && PyErr_Occurred());
            if (!good) PyErr_Clear();
            return good;
        }
        return PyObject_CheckBuffer(object.ptr()) ? view_buffer(object) : view_tensor(object);
    }
    Py_ssize_t from_last(int axis) const { return shape[axes - axis]; }
    int leading(Row row) const { return number ? 0 : axes - row.axes(); }
    bool ends_in(Row row) const {
        return number || (leading(row) >= 0 && std::equal(row.sizes, row.sizes + row.axes(), shape.begin() + leading(row)));
    }
    // One more axis, along which all numbers are the same.
    bool repeat(Py_ssize_t times) {
        if (axes == MOST_AXES) return false;
        shape[axes] = times, strides_[axes++] = 0;
        return true;
    }

    // `size` problems with a row each, or with one row for all; copied where they do not lie as the core reads them.
    grasp::Slices slices(Row row, Py_ssize_t size) {
        const int first = leading(row);
        const Py_ssize_t per = row.count();
        if (number) {
            own_.assign(per, value_);
            return {own_.data(), 0};
        }
        if (!single && lies_along(first, axes)) {
            if (first == 0 || size == 1) return {static_cast<const double*>(data_), 0};
            const Py_ssize_t step = strides_[first - 1];
            if (lies_along(0, first, step)) return {static_cast<const double*>(data_), step};
        }
        own_.resize(first ? size * per : per);
        double* to = own_.data();
        copy(0, 0, to);
        return {own_.data(), first ? per : 0};
    }
    // Float64 one after the other, so many; null: they do not lie so.
    double* run(Py_ssize_t count, bool writable) const {
        Py_ssize_t all = 1;
        for (int a = 0; a < axes; ++a) all *= shape[a];
        const bool good = !number && !single && all == count && lies_along(0, axes) && !(writable && held_ && buffer_.readonly);
        return good ? static_cast<double*>(const_cast<void*>(data_)) : nullptr;
    }

private:
    bool view_buffer(nb::handle object) {
        held_ = PyObject_GetBuffer(object.ptr(), &buffer_, PyBUF_STRIDES | PyBUF_FORMAT) == 0;
        if (!held_) PyErr_Clear();
        if (!held_ || buffer_.ndim >= MOST_AXES) return false;
        single = std::strcmp(buffer_.format, "f") == 0;
        if (!single && std::strcmp(buffer_.format, "d") != 0) return false;
        axes = buffer_.ndim, data_ = buffer_.buf;
        for (int a = 0; a < axes; ++a) {
            if (buffer_.strides[a] % buffer_.itemsize != 0) return false;
            shape[a] = buffer_.shape[a], strides_[a] = buffer_.strides[a] / buffer_.itemsize;
        }
        return true;
    }
    bool view_tensor(nb::handle object) {
        const ExchangeApi* const api = ExchangeApi::of(object);
        nb::dlpack::dltensor seen;
        if (!api || api->view(object.ptr(), &seen) != 0) {
            PyErr_Clear();
            return false;
        }
        constexpr int CPU = 1;
        const auto code = seen.dtype.code;
        single = seen.dtype.bits == 32;
        if (seen.device.device_type != CPU || code != std::uint8_t(nb::dlpack::dtype_code::Float) || seen.dtype.lanes != 1 ||
            (!single && seen.dtype.bits != 64) || !seen.data || seen.ndim >= MOST_AXES || (seen.ndim > 0 && !seen.strides))
            return false;
        axes = seen.ndim, data_ = static_cast<const char*>(seen.data) + seen.byte_offset;
        std::copy_n(seen.shape, axes, shape.begin()), std::copy_n(seen.strides, axes, strides_.begin());
        return true;
    }
    // Whether these axes are one run, whose last one has the stride `step`; the stride of an axis of length 1 is without meaning.
    bool lies_along(int from, int to, Py_ssize_t step = 1) const {
        for (int a = to - 1; a >= from; --a) {
            if (shape[a] != 1 && strides_[a] != step) return false;
            step *= shape[a];
        }
        return true;
    }
    void copy(int axis, Py_ssize_t at, double*& to) const {
        for (Py_ssize_t k = 0; k < shape[axis]; ++k, at += strides_[axis]) {
            if (axis + 1 < axes) copy(axis + 1, at, to);
            else *to++ = single ? double(static_cast<const float*>(data_)[at]) : static_cast<const double*>(data_)[at];
        }
    }

    std::array<Py_ssize_t, MOST_AXES> strides_{};  // in numbers
    const void* data_ = nullptr;
    double value_ = 0.0;
    Py_buffer buffer_{};
    bool held_ = false;
    std::vector<double> own_;
};

// Rows that the core reads or writes, one after the other: float64 of any leading dimensions, or a TypeError (a mistake of the package's own
// code).
template <class Number> class Run {
public:
    // optional: None is null
    Run(nb::handle object, Py_ssize_t count, Py_ssize_t row, bool optional = false) : row_(row) {
        if (optional && object.is_none()) return;
        Tensor tensor;
        if (tensor.view(object)) data_ = tensor.run(count * row, !std::is_const_v<Number>);
        if (!data_) throw nb::type_error("contiguous float64 numbers of another shape are needed");
    }
    Number* operator[](Py_ssize_t k) const { return data_ ? data_ + k * row_ : nullptr; }

private:
    Number* data_ = nullptr;
    Py_ssize_t row_;
};
