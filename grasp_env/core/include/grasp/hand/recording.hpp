// A recording of a hand controller: what it was given and what it did, to run it again elsewhere.
#pragma once
#include <charconv>
#include <cstdio>
#include <string>
#include <grasp/hand/calibration.hpp>
#include <grasp/hand/hand_settings.hpp>
#include <grasp/hand/hand_state.hpp>
#include <grasp/hand/tree_file.hpp>

namespace grasp {

// What happened at a row of a recording.
enum class HandEvent {
  update,      // with a state
  activate,    // with a state
  deactivate,  // without
  take_hold,   // without
  foreign      // an update with a state of another hand, which is ignored
};

// Rows of numbers: the event, the `Hold`, the period of the update [s], the numbers of the state;
// then the status, torques (M,) [N m], commands (M,) in device units, commanded forces (N, 3) [N]
// in contact frames, the share of the friction that each uses (N,), and the duration of the update
// [s]. The constructor allocates; rows beyond its size are lost.
class HandRecording {
 public:
  HandRecording() = default;
  // header: as JSON
  HandRecording(int joints, int fingers, std::size_t rows, std::string header)
      : header_(std::move(header)) {
    const auto name = [&](const std::string& what, int count, const char* unit) {
      for (int k = 0; k < count; ++k) {
        std::string& column = columns_.emplace_back(what);
        if (count > 1) column.append(".").append(std::to_string(k));
        column.append(" [").append(unit).append("]");
      }
    };
    name("event", 1, "1");
    name("hold", 1, "1");
    name("period", 1, "s");
    for (const auto& part : HandState::TABLE)
      name(part.name, part.per_joint * joints + part.per_tip * fingers + part.more, part.unit);
    name("status", 1, "1");
    name("torques", joints, "N m");
    name("commands", joints, "device units");
    name("force", 3 * fingers, "N");
    name("friction_used", fingers, "1");
    name("duration", 1, "s");
    numbers_.resize(rows * width());
    most_ = rows;
  }

  std::size_t width() const { return columns_.size(); }
  std::size_t rows() const { return rows_; }
  bool full() const { return width() == 0 || rows_ >= most_; }
  std::span<const double> numbers() const { return std::span(numbers_).first(rows_ * width()); }
  const std::vector<std::string>& columns() const { return columns_; }
  const std::string& header() const { return header_; }

  // Take no further rows.
  void end() { most_ = rows_; }
  // Add a row; each part is copied in turn.
  template <class... Parts> void add(const Parts&... parts) {
    if (full()) return;
    double* to = &numbers_[rows_ * width()];
    const auto copy = [&](const auto& part) {
      if constexpr (std::is_convertible_v<decltype(part), double>)
        *to++ = double(part);
      else
        to = std::copy(part.begin(), part.end(), to);
    };
    (copy(parts), ...);
    ++rows_;
  }
  // Write CSV: a comment with the header, the columns with their units, the rows. The file appears
  // when it is complete. Throws std::runtime_error.
  void write(const std::string& path) const {
    const std::string temporary = path + ".part";
    std::FILE* file = std::fopen(temporary.c_str(), "w");
    if (!file) throw std::runtime_error("cannot write " + temporary);
    std::fprintf(file, "# %s\n", header_.c_str());
    for (std::size_t k = 0; k < width(); ++k)
      std::fprintf(file, "%s%c", columns_[k].c_str(), k + 1 < width() ? ',' : '\n');
    for (std::size_t k = 0; k < rows_ * width(); ++k)
      std::fprintf(file, "%s%c", digits(numbers_[k]).text, (k + 1) % width() ? ',' : '\n');
    const bool good = !std::ferror(file);
    if (std::fclose(file) != 0 || !good || std::rename(temporary.c_str(), path.c_str()) != 0) {
      std::remove(temporary.c_str());
      throw std::runtime_error("cannot write " + path);
    }
  }

  // JSON of a hand, the settings of its controller, its calibration and home posture: all that a
  // replay needs.
  static std::string describe(const Tree& hand, const HandControllerSettings& settings,
                              const Calibration& calibration, std::span<const double> home) {
    std::string out = R"({"kind": "grasp hand recording 1", "hand": ")";
    for (unsigned char byte : TreeFile::write(hand)) {
      constexpr char DIGITS[] = "0123456789abcdef";
      out.push_back(DIGITS[byte >> 4]);
      out.push_back(DIGITS[byte & 15]);
    }
    out.append(R"(", "settings": {)");
    each_setting(settings, [&](const char* name, const auto& value) {
      if (out.back() != '{') out.append(", ");
      out.append("\"").append(name).append("\": ").append(json(value));
    });
    out.append(R"(}, "calibration": {"torques": )").append(json(calibration.torques));
    out.append(R"(, "units": )").append(json(calibration.units));
    out.append(R"(, "friction": )").append(json(calibration.friction));
    out.append(R"(, "dead_band": )").append(json(calibration.dead_band));
    out.append(R"(, "fade": )").append(json(calibration.fade));
    out.append(R"(, "resolution": )").append(json(calibration.resolution));
    out.append(R"(}, "home": )").append(json(home)).append("}");
    return out;
  }

 private:
  std::vector<std::string> columns_;
  std::vector<double> numbers_;
  std::size_t rows_ = 0, most_ = 0;
  std::string header_;

  // A number with 17 digits, whatever the locale.
  struct Digits {
    char text[32];
  };
  static Digits digits(double value) {
    Digits out;
    *std::to_chars(out.text, out.text + sizeof out.text, value, std::chars_format::general, 17)
         .ptr = 0;
    return out;
  }
  // Infinity is null.
  static std::string json(double value) {
    return std::isfinite(value) ? digits(value).text : "null";
  }
  static std::string json(const Spring& spring) {
    const double numbers[] = {spring.gain, spring.damping, spring.limit};
    return json(std::span<const double>(numbers));
  }
  template <std::ranges::range Values> static std::string json(const Values& values) {
    std::string out = "[";
    for (const auto& value : values) {
      if (out.size() > 1) out.append(", ");
      out.append(json(value));
    }
    out.push_back(']');
    return out;
  }
};

}  // namespace grasp
