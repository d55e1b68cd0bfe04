// A trained model for the contacts of one grasp as one file, written by Python (`LearnedInitialForce.export`), read without it.
//
// Little-endian: "GRASPM2\n", a hash of all that follows, then doubles: how many sizes and the sizes of the network, the other
// numbers of `Model`, the null space's length and its numbers; then the weights of the network as floats. A file may come from
// anywhere: what is read is bounded by its length, and every number is looked at.
#pragma once
#include <bit>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>
#include <grasp/learned/learned.hpp>

namespace grasp {

static_assert(std::endian::native == std::endian::little, "model files hold little-endian numbers");

class ModelFile {
public:
    static constexpr std::size_t LARGEST_FILE = std::size_t(1) << 26;  // bytes; the shipped model has 22 thousand

    static std::string write(const Model& model) {
        ModelFile file;
        const auto sizes = model.network.sizes();
        file.put(double(sizes.size()));
        for (const int size : sizes) file.put(double(size));
        const auto numbers = packed(model);
        for (const double value : numbers) file.put(value);
        file.put(double(model.null_space.size()));
        for (const double value : model.null_space) file.put(value);
        std::vector<float> weights;
        model.network.write(weights);
        for (const float value : weights) file.put(value);
        const std::uint64_t check = hash(file.bytes_);
        return std::string(MAGIC) + std::string(reinterpret_cast<const char*>(&check), sizeof check) + file.bytes_;
    }

    // None where the bytes are not those of a whole model.
    static std::optional<Model> read(std::string_view bytes) {
        std::uint64_t check;
        const std::size_t head = MAGIC.size() + sizeof check;
        if (bytes.size() < head || bytes.size() > LARGEST_FILE || !bytes.starts_with(MAGIC)) return {};
        std::memcpy(&check, bytes.data() + MAGIC.size(), sizeof check);
        if (check != hash(bytes.substr(head))) return {};
        return body(bytes.substr(head));
    }

    // What follows the hash, by itself: for fuzzing.
    static std::optional<Model> body(std::string_view bytes) {
        ModelFile file;
        file.left_ = bytes;
        std::vector<int> sizes(std::size_t(file.whole(MOST_STAGES + 1)));
        for (int& size : sizes) size = file.whole(WIDEST);
        const std::size_t network = Network::numbers(sizes);
        Model model;
        auto numbers = packed(model);
        for (double& value : numbers) value = file.number();
        unpack(numbers, model);
        const int inside = file.whole(int(MOST_NULL));
        if (!file.good_ || !network || file.left_.size() != sizeof(double) * inside + sizeof(float) * network) return {};
        model.null_space.resize(inside);
        for (double& value : model.null_space) value = file.number();
        std::vector<float> weights(network);
        for (float& value : weights) value = file.take<float>();
        if (!file.good_ || !(model.scale > 0.0) || !model.normalisation.good()) return {};
        model.network = Network(sizes, weights.data());
        return model;
    }

    // Throws std::invalid_argument where there is no such model.
    static Model load(const std::string& path) {
        std::string bytes;
        if (std::FILE* file = std::fopen(path.c_str(), "rb")) {
            char part[4096];
            for (std::size_t got; bytes.size() <= LARGEST_FILE && (got = std::fread(part, 1, sizeof part, file)) > 0;)
                bytes.append(part, got);
            std::fclose(file);
        }
        std::optional<Model> model = read(bytes);
        if (!model) throw std::invalid_argument(path + " is no whole model file: LearnedInitialForce.export writes one");
        return *std::move(model);
    }

private:
    static constexpr std::string_view MAGIC = "GRASPM2\n";
    static constexpr std::size_t MOST_NULL = LARGEST_FILE / sizeof(double);
    std::string bytes_;
    std::string_view left_;
    bool good_ = true;

    // The numbers of a model besides its weights, in their order.
    static std::array<double, 9> packed(const Model& m) {
        const Normalisation& by = m.normalisation;
        return {by.length,         by.floor,   by.log_mean, by.log_scale, by.friction_mean,
                by.friction_scale, m.friction, m.scale,     m.largest};
    }
    static void unpack(const std::array<double, 9>& n, Model& m) {
        m.normalisation = {n[0], n[1], n[2], n[3], n[4], n[5]};
        m.friction = n[6], m.scale = n[7], m.largest = n[8];
    }

    template <class T> void put(T value) { bytes_.append(reinterpret_cast<const char*>(&value), sizeof value); }
    void put(int value) { put(double(value)); }
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
    int whole(int most) {
        const double value = number();
        good_ = good_ && value >= 0.0 && value <= most && value == std::floor(value);
        return good_ ? int(value) : 0;
    }

    static std::uint64_t hash(std::string_view bytes) {  // FNV-1a
        std::uint64_t out = 14695981039346656037u;
        for (const char byte : bytes) out = (out ^ std::uint8_t(byte)) * 1099511628211u;
        return out;
    }
};

}  // namespace grasp
