// The file of a trained model for the contacts of one grasp. Python writes it
// (`LearnedInitialForce.export`); C++ reads it without Python.
//
// `KIND` and hash of `number_file.hpp`, number of sizes and sizes of the network, the other numbers
// of `Model`, length and numbers of the null space, the weights of the network and of `pairs` as
// floats.
#pragma once
#include <stdexcept>
#include <grasp/learned/learned.hpp>
#include <grasp/detail/number_file.hpp>

namespace grasp {

class ModelFile {
 public:
  static std::string write(const Model& model) {
    NumberWriter file;
    const auto sizes = model.network.sizes();
    file.put(int(sizes.size()));
    for (const int size : sizes) file.put(size);
    for (const double value : packed(model)) file.put(value);
    file.put(int(model.null_space.size()));
    for (const double value : model.null_space) file.put(value);
    std::vector<float> weights;
    model.network.write(weights);
    model.pairs.write(weights);
    for (const float value : weights) file.put(value);
    return file.file(KIND);
  }

  // Return nothing unless the bytes are those of a whole model.
  static std::optional<Model> read(std::string_view bytes) {
    const auto numbers = NumberReader::body(bytes, KIND);
    return numbers ? body(*numbers) : std::nullopt;
  }

  // Parse the part after the hash; separate for fuzzing.
  static std::optional<Model> body(std::string_view bytes) {
    NumberReader file(bytes);
    std::vector<int> sizes(std::size_t(file.whole(MOST_STAGES + 1)));
    for (int& size : sizes) size = file.whole(WIDEST);
    const std::size_t network = Network::numbers(sizes);
    const int pair_sizes[] = {6, network ? 2 * (sizes.front() - PLAIN_FEATURES) : 0};
    const std::size_t pairs = Network::numbers(pair_sizes);
    Model model;
    auto numbers = packed(model);
    for (double& value : numbers) value = file.number();
    unpack(numbers, model);
    const int inside = file.whole(int(MOST_NULL));
    if (!file.good() || !network || !pairs ||
        file.bytes_left() != sizeof(double) * inside + sizeof(float) * (network + pairs))
      return {};
    model.null_space.resize(inside);
    for (double& value : model.null_space) value = file.number();
    std::vector<float> weights(network + pairs);
    for (float& value : weights) value = file.take<float>();
    if (!file.good() || !(model.scale > 0.0) || !model.normalisation.good()) return {};
    model.network = Network(sizes, weights.data());
    model.pairs = Network(pair_sizes, weights.data() + network);
    return model;
  }

  // Throws std::invalid_argument if the file holds no such model.
  static Model load(const std::string& path) {
    std::optional<Model> model = read(NumberReader::bytes(path));
    if (!model)
      throw std::invalid_argument(path +
                                  " is no whole model file: LearnedInitialForce.export writes one");
    return *std::move(model);
  }

 private:
  static constexpr std::string_view KIND = "GRASPM3\n";
  static constexpr std::size_t MOST_NULL = LARGEST_FILE / sizeof(double);

  // The numbers of a model besides its weights, in file order.
  static std::array<double, 9> packed(const Model& m) {
    const Normalisation& by = m.normalisation;
    return {by.floor,          by.smoothing, by.log_mean, by.log_scale, by.friction_mean,
            by.friction_scale, m.friction,   m.scale,     m.largest};
  }
  static void unpack(const std::array<double, 9>& n, Model& m) {
    m.normalisation = {n[0], n[1], n[2], n[3], n[4], n[5]};
    m.friction = n[6];
    m.scale = n[7];
    m.largest = n[8];
  }
};

}  // namespace grasp
