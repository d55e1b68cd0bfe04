// A hand as one file, written by Python (`HandKinematics.export`).
//
// Kind "GRASPH1\n" of `number_file.hpp`: numbers of links and tips; the numbers of each `Link`
// in their order, with 1e300 for a missing limit; the numbers of each `Tip`.
#pragma once
#include <stdexcept>
#include <grasp/hand/tree.hpp>
#include <grasp/detail/number_file.hpp>

namespace grasp {

class TreeFile {
 public:
  static constexpr int MOST_LINKS = 4096, MOST_TIPS = 64;  // a solver has one bit per contact

  static std::string write(const Tree& tree) {
    NumberWriter file;
    file.put(tree.joints());
    file.put(tree.fingers());
    for (Link link : tree.links) {
      file.put(link.parent);
      for_each(link, [&](double& value) { file.put(std::clamp(value, -NONE, NONE)); });
      file.put(int(link.sliding));
      file.put(link.driver);
    }
    for (Tip tip : tree.tips) {
      file.put(tip.link);
      for_each(tip, [&](double& value) { file.put(value); });
    }
    return file.file(KIND);
  }

  // Return nothing unless the bytes are those of a whole hand.
  static std::optional<Tree> read(std::string_view bytes) {
    const auto numbers = NumberReader::body(bytes, KIND);
    return numbers ? body(*numbers) : std::nullopt;
  }

  // Parse the part after the hash; separate for fuzzing.
  static std::optional<Tree> body(std::string_view bytes) {
    NumberReader file(bytes);
    Tree tree;
    const int links = file.whole(MOST_LINKS, 1);
    const int tips = file.whole(MOST_TIPS);
    for (int j = 0; j < links && file.good(); ++j) {
      Link& link = tree.links.emplace_back();
      link.parent = file.whole(j - 1, -1);
      for_each(link, [&](double& value) { value = file.number(); });
      for (double* limit : {&link.lower, &link.upper, &link.torque_limit})
        if (std::abs(*limit) >= NONE) *limit = std::copysign(infinity, *limit);
      link.sliding = file.whole(1);
      link.driver = file.whole(links - 1, -1);
    }
    for (int i = 0; i < tips && file.good(); ++i) {
      Tip& tip = tree.tips.emplace_back();
      tip.link = file.whole(links - 1);
      for_each(tip, [&](double& value) { value = file.number(); });
    }
    if (!file.good() || file.bytes_left() || tree.fault()) return {};
    return tree;
  }

  // Throws std::invalid_argument if the file holds no such hand.
  static std::shared_ptr<const Tree> load(const std::string& path) {
    std::optional<Tree> tree = read(NumberReader::bytes(path));
    if (!tree)
      throw std::invalid_argument(path +
                                  " is not a complete hand file: HandKinematics.export writes one");
    return std::make_shared<const Tree>(*std::move(tree));
  }

 private:
  static constexpr std::string_view KIND = "GRASPH1\n";
  static constexpr double NONE = 1e300;

  template <class F> static void for_each(Point& a, F&& f) {
    f(a.u);
    f(a.o);
    f(a.t);
  }
  template <class F> static void for_each(Link& link, F&& f) {
    for_each(link.offset, f);
    for (Point& row : link.rotation.rows) for_each(row, f);
    for_each(link.axis, f);
    f(link.mass);
    for_each(link.center, f);
    for (double* value : {&link.lower, &link.upper, &link.torque_limit, &link.ratio, &link.shift})
      f(*value);
    for (double& value : link.inertia) f(value);
  }
  template <class F> static void for_each(Tip& tip, F&& f) {
    for_each(tip.center, f);
    f(tip.radius);
  }
};

}  // namespace grasp
