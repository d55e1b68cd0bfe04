// Internal forces in coordinates that follow moving contacts smoothly.
#pragma once
#include <grasp/contacts/contacts.hpp>

namespace grasp {

// An orthonormal basis of the null space of G (forces) close to object-frame directions: the polar factor B (B^T B)^-1/2 of their
// projection, the limit of B <- B (3 - B^T B) / 2, as a projection has no singular value above one.
class NullSpace {
public:
    // reference: (3N, 3N - 6) object-frame directions
    NullSpace(int count, const double* reference)
        : size_(3 * count), columns_(std::max(0, 3 * count - 6)), reference_(reference, reference + size_ * columns_),
          basis_(size_ * columns_), gram_(columns_ * columns_), line_(columns_), rows_(6 * size_) {}

    int dimension() const { return columns_; }

    // False where the reference does not span the null space of the current contacts.
    bool place(const Contacts& c) {
        for (int j = 0; j < size_; ++j)
            for (int k = 0; k < columns_; ++k) {
                double total = 0.0;
                for (int a = 0; a < 3; ++a)
                    total += c.frames[9 * (j / 3) + 3 * a + j % 3] * reference_[columns_ * (3 * (j / 3) + a) + k];
                basis_[columns_ * j + k] = total;
            }
        c.orthonormal(rows_);
        reject();
        for (int round = 0; round < ROUNDS; ++round) {
            double worst = 0.0;
            for (int b = 0; b < columns_; ++b)
                for (int k = 0; k <= b; ++k) {
                    double total = 0.0;
                    for (int j = 0; j < size_; ++j) total += basis_[columns_ * j + b] * basis_[columns_ * j + k];
                    gram_[columns_ * b + k] = gram_[columns_ * k + b] = total;
                    const double off = std::abs(total - (b == k));
                    worst = off <= worst ? worst : off;  // keeps what is not a number
                }
            if (worst <= CLOSE) {
                reject();
                return true;
            }
            for (int j = 0; j < size_; ++j) {
                double* row = &basis_[columns_ * j];
                for (int k = 0; k < columns_; ++k) {
                    line_[k] = 1.5 * row[k];
                    for (int b = 0; b < columns_; ++b) line_[k] -= 0.5 * row[b] * gram_[columns_ * b + k];
                }
                std::copy(line_.begin(), line_.end(), row);
            }
        }
        return false;
    }

    // force (3N,) [N] of coordinates (3N - 6,): component j
    double force(int j, const double* coordinates) const {
        double total = 0.0;
        for (int k = 0; k < columns_; ++k) total += basis_[columns_ * j + k] * coordinates[k];
        return total;
    }

private:
    // Of a polar factor; six halve the distance of a singular value of 0.1, the last three take all digits.
    static constexpr int ROUNDS = 60;
    static constexpr double CLOSE = 1e-14;  // largest entry of B^T B - 1 at which the columns count as orthonormal
    int size_, columns_;
    std::vector<double> reference_, basis_, gram_, line_, rows_;

    // Takes off what lies along the rows of G.
    void reject() {
        for (int k = 0; k < columns_; ++k)
            for (int r = 0; r < 6; ++r) {
                double total = 0.0;
                for (int j = 0; j < size_; ++j) total += rows_[size_ * r + j] * basis_[columns_ * j + k];
                for (int j = 0; j < size_; ++j) basis_[columns_ * j + k] -= total * rows_[size_ * r + j];
            }
    }
};

}  // namespace grasp
