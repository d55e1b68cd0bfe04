// Memory for objects rebuilt at every use, so that real-time code allocates nothing: taken piece by
// piece, returned all at once.
#pragma once
#include <cstddef>
#include <functional>
#include <memory>
#include <new>
#include <vector>

namespace grasp {

// While an arena is in `Use`, this thread's `ArenaVector` arrays take their memory from it; what
// does not fit comes from the heap.
class Arena {
 public:
  explicit Arena(std::size_t bytes = 0)
      : memory_(bytes ? new (std::nothrow) std::byte[bytes] : nullptr),
        size_(memory_ ? bytes : 0) {}
  Arena(Arena&&) = delete;

  std::size_t size() const { return size_; }
  // Return all memory; nothing that uses it may be alive.
  void clear() { used_ = 0; }
  // Clear, and make room for at least `bytes`.
  void reserve(std::size_t bytes) {
    clear();
    if (bytes <= size_) return;
    memory_.reset();
    size_ = 0;
    memory_.reset(new std::byte[bytes]);
    size_ = bytes;
  }
  template <class T> static constexpr std::size_t bytes_needed(std::size_t many) {
    return whole(many * sizeof(T));
  }

  class Use {
   public:
    explicit Use(Arena& arena) : before_(current()) { current() = &arena; }
    ~Use() { current() = before_; }
    Use(Use&&) = delete;

   private:
    Arena* before_;
  };
  // Returns at its end all memory taken since its start. Declare it before whatever takes memory.
  class Scope {
   public:
    Scope() : arena_(current()), used_(arena_ ? arena_->used_ : 0) {}
    ~Scope() {
      if (arena_) arena_->used_ = used_;
    }
    Scope(Scope&&) = delete;

   private:
    Arena* arena_;
    std::size_t used_;
  };

  // Allocator for containers; uses the arena that was in use at construction.
  template <class T> struct Allocator {
    using value_type = T;
    Arena* arena = current();

    Allocator() = default;
    template <class Other> Allocator(const Allocator<Other>& other) : arena(other.arena) {}
    Allocator select_on_container_copy_construction() const { return {}; }
    T* allocate(std::size_t many) {
      static_assert(alignof(T) <= ALIGNMENT);
      void* taken = arena ? arena->take(many * sizeof(T)) : nullptr;
      return taken ? static_cast<T*>(taken) : std::allocator<T>().allocate(many);
    }
    void deallocate(T* at, std::size_t many) {
      if (!(arena && arena->owns(at))) std::allocator<T>().deallocate(at, many);
    }
    friend bool operator==(const Allocator& a, const Allocator& b) { return a.arena == b.arena; }
  };

 private:
  static constexpr std::size_t ALIGNMENT = 16;
  std::unique_ptr<std::byte[]> memory_;
  std::size_t size_, used_ = 0;

  static Arena*& current() {
    static thread_local Arena* arena = nullptr;
    return arena;
  }
  static constexpr std::size_t whole(std::size_t bytes) {
    return (bytes + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
  }
  void* take(std::size_t bytes) {
    if (whole(bytes) > size_ - used_) return nullptr;
    void* at = memory_.get() + used_;
    used_ += whole(bytes);
    return at;
  }
  bool owns(const void* at) const {
    return std::less_equal<>()(static_cast<const void*>(memory_.get()), at) &&
           std::less<>()(at, memory_.get() + size_);
  }
};

template <class T> using ArenaVector = std::vector<T, Arena::Allocator<T>>;

}  // namespace grasp
