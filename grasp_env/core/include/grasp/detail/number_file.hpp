// Files of numbers that Python writes and C++ programs read, little-endian: eight letters for kind
// and version, a hash of everything that follows, then the numbers. Files are not trusted: reading
// stays within the file's length, and every number is checked.
#pragma once
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <string_view>

namespace grasp {

static_assert(std::endian::native == std::endian::little,
              "number files hold little-endian numbers");

// bytes; the shipped model has 22 thousand numbers
inline constexpr std::size_t LARGEST_FILE = std::size_t(1) << 26;

class NumberWriter {
 public:
  template <class T> void put(T value) {
    bytes_.append(reinterpret_cast<const char*>(&value), sizeof value);
  }
  void put(int value) { put(double(value)); }
  // Return the whole file. kind: eight letters.
  std::string file(std::string_view kind) const {
    const std::uint64_t check = hash(bytes_);
    return std::string(kind) + std::string(reinterpret_cast<const char*>(&check), sizeof check) +
           bytes_;
  }
  static std::uint64_t hash(std::string_view bytes) {  // FNV-1a
    std::uint64_t out = 14695981039346656037u;
    for (const char byte : bytes) out = (out ^ std::uint8_t(byte)) * 1099511628211u;
    return out;
  }

 private:
  std::string bytes_;
};

class NumberReader {
 public:
  explicit NumberReader(std::string_view numbers) : left_(numbers) {}

  // Return what follows kind and hash; empty unless the bytes are a whole file of that kind.
  static std::optional<std::string_view> body(std::string_view bytes, std::string_view kind) {
    std::uint64_t check;
    const std::size_t head = kind.size() + sizeof check;
    if (bytes.size() < head || bytes.size() > LARGEST_FILE || !bytes.starts_with(kind)) return {};
    std::memcpy(&check, bytes.data() + kind.size(), sizeof check);
    if (check != NumberWriter::hash(bytes.substr(head))) return {};
    return bytes.substr(head);
  }
  // Return the bytes of a file; empty if it cannot be read.
  static std::string bytes(const std::string& path) {
    std::string out;
    if (std::FILE* file = std::fopen(path.c_str(), "rb")) {
      char buffer[4096];
      for (std::size_t count;
           out.size() <= LARGEST_FILE && (count = std::fread(buffer, 1, sizeof buffer, file)) > 0;)
        out.append(buffer, count);
      std::fclose(file);
    }
    return out;
  }

  // Return the next number, which must be finite; 0 from the first bad number on.
  template <class T> T take() {
    T value{};
    good_ = good_ && left_.size() >= sizeof value;
    if (!good_) return T{};
    std::memcpy(&value, left_.data(), sizeof value);
    left_.remove_prefix(sizeof value);
    good_ = std::abs(value) <= std::numeric_limits<T>::max();
    return good_ ? value : T{};
  }
  double number() { return take<double>(); }
  // Return a whole number from `least` to `most`.
  int whole(int most, int least = 0) {
    const double value = number();
    good_ = good_ && value >= least && value <= most && value == std::floor(value);
    return good_ ? int(value) : 0;
  }
  // True if all numbers so far were present and valid.
  bool good() const { return good_; }
  std::size_t bytes_left() const { return left_.size(); }

 private:
  std::string_view left_;
  bool good_ = true;
};

}  // namespace grasp
