// Whole leaves and tiles between Rust and OpenVDB's trees. Compiles in 5 s (see internal.h for what makes it
// longer).

#include "internal.h"

#include <openvdb/tree/ValueAccessor.h>

#include <algorithm>
#include <cstring>
#include <limits>
#include <stdexcept>

namespace vdb_edit {

namespace {

constexpr std::size_t kNodeWords = 64; // 16^3 slots

} // namespace

// --- reading ---

namespace {

/// The leaves of a tree of float or double.
template<typename GridT>
class LeavesOf final : public Leaves::Impl {
    using TreeT = typename GridT::TreeType;
    using LeafT = typename TreeT::LeafNodeType;
    using Upper = typename TreeT::RootNodeType::ChildNodeType; // 32^3 slots of 128^3 voxels
    using Lower = typename Upper::ChildNodeType;               // 16^3 slots of 8^3 voxels

public:
    explicit LeavesOf(typename GridT::ConstPtr grid) : grid_(std::move(grid))
    {
        const TreeT& tree = grid_->tree();
        tree.getNodes(leaves_);
        tree.getNodes(lower_);
        tree.getNodes(upper_);
    }

    std::size_t count() const override { return leaves_.size(); }
    double background() const override { return static_cast<double>(grid_->background()); }
    void origins(rust::Slice<std::int32_t> out) const override { write_origins(leaves_, out); }

    void copy(std::size_t first, rust::Slice<float> values, rust::Slice<std::uint64_t> masks) const override
    {
        const std::size_t n = values.size() / kLeafVoxels;
        require(values.size() == n * kLeafVoxels && masks.size() == n * kMaskWords, "copy: wrong length");
        require(first <= leaves_.size() && n <= leaves_.size() - first, "copy: leaves out of range");
        for (std::size_t i = 0; i < n; ++i) {
            const LeafT& leaf = *leaves_[first + i];
            // A memcpy for float, a conversion for double.
            const auto* source = leaf.buffer().data();
            std::transform(source, source + kLeafVoxels, values.data() + i * kLeafVoxels,
                [](auto v) { return static_cast<float>(v); });
            for (std::size_t w = 0; w < kMaskWords; ++w) {
                masks[i * kMaskWords + w] = leaf.getValueMask().template getWord<std::uint64_t>(openvdb::Index(w));
            }
        }
    }

    std::size_t node_count() const override { return lower_.size(); }
    void node_origins(rust::Slice<std::int32_t> out) const override { write_origins(lower_, out); }

    void node_inside(rust::Slice<std::uint64_t> out) const override
    {
        require(out.size() == lower_.size() * kNodeWords, "node_inside: wrong length");
        std::fill(out.begin(), out.end(), 0);
        for (std::size_t i = 0; i < lower_.size(); ++i) {
            std::uint64_t* words = out.data() + i * kNodeWords;
            for (auto slot = lower_[i]->cbeginChildOff(); slot; ++slot) {
                if (slot.getValue() < 0) words[slot.pos() >> 6] |= std::uint64_t(1) << (slot.pos() & 63);
            }
        }
    }

    void tiles(rust::Vec<Tile>& out) const override
    {
        const auto add = [&out](const openvdb::Coord& at, std::uint32_t size, double value, bool active) {
            out.push_back(Tile{at.x(), at.y(), at.z(), size, static_cast<float>(value), active});
        };
        for (const Lower* node : lower_) {
            for (auto it = node->cbeginValueOn(); it; ++it) add(it.getCoord(), 8, it.getValue(), true);
        }
        for (const Upper* node : upper_) {
            for (auto it = node->cbeginChildOff(); it; ++it) {
                if (it.isValueOn() || it.getValue() < 0) add(it.getCoord(), 128, it.getValue(), it.isValueOn());
            }
        }
        for (auto it = grid_->tree().root().cbeginValueAll(); it; ++it) {
            if (it.isValueOn() || it.getValue() < 0) add(it.getCoord(), 4096, it.getValue(), it.isValueOn());
        }
    }

    void inactive_tile_range(double& low, double& high) const override
    {
        low = std::numeric_limits<double>::infinity();
        high = -low;
        const auto scan = [&](auto it) {
            for (; it; ++it) {
                if (it.isValueOn()) continue;
                low = std::min(low, static_cast<double>(it.getValue()));
                high = std::max(high, static_cast<double>(it.getValue()));
            }
        };
        for (const Lower* node : lower_) scan(node->cbeginChildOff());
        for (const Upper* node : upper_) scan(node->cbeginChildOff());
        scan(grid_->tree().root().cbeginValueAll());
    }

private:
    typename GridT::ConstPtr grid_;
    std::vector<const LeafT*> leaves_;
    std::vector<const Lower*> lower_;
    std::vector<const Upper*> upper_;
};

} // namespace

Leaves::Leaves(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
Leaves::~Leaves() = default;
std::size_t Leaves::count() const { return impl->count(); }
double Leaves::background() const { return impl->background(); }
void Leaves::origins(rust::Slice<std::int32_t> out) const { impl->origins(out); }
std::size_t Leaves::node_count() const { return impl->node_count(); }
void Leaves::node_origins(rust::Slice<std::int32_t> out) const { impl->node_origins(out); }
void Leaves::node_inside(rust::Slice<std::uint64_t> out) const { impl->node_inside(out); }
void Leaves::inactive_tile_range(double& low, double& high) const { impl->inactive_tile_range(low, high); }

void Leaves::copy(std::size_t first, rust::Slice<float> values, rust::Slice<std::uint64_t> masks) const
{
    impl->copy(first, values, masks);
}

rust::Vec<Tile> Leaves::tiles() const
{
    rust::Vec<Tile> out;
    impl->tiles(out);
    return out;
}

std::unique_ptr<Leaves> leaves_of(const openvdb::GridBase::ConstPtr& grid)
{
    if (const auto floats = openvdb::gridConstPtrCast<openvdb::FloatGrid>(grid)) {
        return std::make_unique<Leaves>(std::make_unique<LeavesOf<openvdb::FloatGrid>>(floats));
    }
    if (const auto doubles = openvdb::gridConstPtrCast<openvdb::DoubleGrid>(grid)) {
        return std::make_unique<Leaves>(std::make_unique<LeavesOf<openvdb::DoubleGrid>>(doubles));
    }
    throw std::invalid_argument("a grid of type " + grid->type() + " holds no scalar values");
}

std::unique_ptr<Leaves> float_grid_leaves(const FloatGrid& grid) { return leaves_of(grid.impl->grid); }

// --- building ---

namespace {

void set_mask(LeafNode& leaf, const std::uint64_t* words)
{
    LeafNode::NodeMaskType mask;
    for (std::size_t w = 0; w < kMaskWords; ++w) mask.getWord<std::uint64_t>(openvdb::Index(w)) = words[w];
    leaf.setValueMask(mask);
}

} // namespace

FloatGrid::FloatGrid(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
FloatGrid::~FloatGrid() = default;

openvdb::FloatGrid::Ptr make_float_grid(double background)
{
    initialize();
    auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(openvdb::GridBase::createGrid("Tree_float_5_4_3"));
    if (!grid) throw std::runtime_error("OpenVDB does not know its own float grids");
    grid->tree().root().setBackground(static_cast<float>(background), /*updateChildNodes=*/false);
    return grid;
}

std::unique_ptr<FloatGrid> new_level_set(double background)
{
    auto grid = make_float_grid(background);
    grid->setGridClass(openvdb::GRID_LEVEL_SET);
    return wrap(std::move(grid));
}

std::unique_ptr<FloatGrid> new_float_grid(double background) { return wrap(make_float_grid(background)); }

void FloatGrid::add_leaves(rust::Slice<const std::int32_t> origins)
{
    require(origins.size() % 3 == 0, "add_leaves: wrong length");
    openvdb::FloatTree& tree = impl->grid->tree();
    openvdb::tree::ValueAccessor<openvdb::FloatTree> accessor(tree);
    const float background = tree.background();
    impl->leaves.reserve(impl->leaves.size() + origins.size() / 3);
    for (std::size_t i = 0; i < origins.size(); i += 3) {
        const openvdb::Coord origin(origins[i], origins[i + 1], origins[i + 2]);
        require(((origin[0] | origin[1] | origin[2]) & 7) == 0, "add_leaves: an origin is no multiple of 8");
        require(accessor.probeConstLeaf(origin) == nullptr, "add_leaves: two leaves at one place");
        // Without its buffer: that is allocated where it is filled, in parallel.
        auto leaf = std::make_unique<LeafNode>(openvdb::PartialCreate(), origin, background, false);
        leaf->setTransientData(static_cast<openvdb::Index32>(impl->leaves.size()));
        accessor.addLeaf(leaf.get());
        impl->leaves.push_back(leaf.release());
    }
}

void FloatGrid::fill(std::size_t first, rust::Slice<const float> values, rust::Slice<const std::uint64_t> masks) const
{
    const auto& leaves = impl->leaves;
    const std::size_t n = values.size() / kLeafVoxels;
    require(values.size() == n * kLeafVoxels && masks.size() == n * kMaskWords, "fill: wrong length");
    require(first <= leaves.size() && n <= leaves.size() - first, "fill: leaves out of range");
    for (std::size_t i = 0; i < n; ++i) {
        LeafNode& leaf = *leaves[first + i];
        leaf.allocate();
        std::memcpy(leaf.buffer().data(), values.data() + i * kLeafVoxels, kLeafVoxels * sizeof(float));
        set_mask(leaf, masks.data() + i * kMaskWords);
    }
}

void FloatGrid::lend(rust::Slice<const float> values, rust::Slice<const std::uint64_t> mask)
{
    require(values.size() == kLeafVoxels && mask.size() == kMaskWords, "lend: wrong length");
    require(impl->lent.size() < impl->leaves.size(), "lend: there is no such leaf");
    impl->lent.reserve(impl->leaves.size());
    set_mask(*impl->leaves[impl->lent.size()], mask.data());
    impl->lent.push_back(values.data());
}

void FloatGrid::add_tiles(rust::Slice<const Tile> tiles)
{
    openvdb::tree::ValueAccessor<openvdb::FloatTree> accessor(impl->grid->tree());
    for (const Tile& tile : tiles) {
        const openvdb::Index level = tile.size == 8 ? 1 : tile.size == 128 ? 2 : tile.size == 4096 ? 3 : 0;
        require(level > 0, "add_tiles: a tile has an edge of 8, 128 or 4096 voxels");
        const openvdb::Coord origin(tile.x, tile.y, tile.z);
        require(accessor.probeConstLeaf(origin) == nullptr, "add_tiles: there is a leaf in the tile's place");
        accessor.addTile(level, origin, tile.value, tile.active);
    }
}

openvdb::math::Transform::Ptr linear_transform(rust::Slice<const double> m)
{
    require(m.size() == 16, "a transform has 16 numbers");
    // OpenVDB multiplies rows from the left: the matrix is the transpose of ours.
    openvdb::Mat4d mat;
    for (int r = 0; r < 4; ++r) {
        for (int c = 0; c < 4; ++c) mat(r, c) = m[static_cast<std::size_t>(c * 4 + r)];
    }
    using openvdb::math::Transform;
    const openvdb::Vec3d scale(mat(0, 0), mat(1, 1), mat(2, 2)), translation(mat(3, 0), mat(3, 1), mat(3, 2));
    const bool axis_aligned = mat(0, 1) == 0 && mat(0, 2) == 0 && mat(1, 0) == 0 && mat(1, 2) == 0 && mat(2, 0) == 0 &&
        mat(2, 1) == 0;
    if (!axis_aligned) return Transform::createLinearTransform(mat);
    // Step by step: from a matrix OpenVDB would compute the scale as a difference of positions, and lose digits of it where
    // the translation is large. The uniform maps are what other programs expect.
    const bool uniform = scale[0] == scale[1] && scale[1] == scale[2] && scale[0] > 0;
    auto transform = Transform::createLinearTransform(uniform ? scale[0] : 1.0);
    if (!uniform) transform->postScale(scale);
    if (translation != openvdb::Vec3d(0.0)) transform->postTranslate(translation);
    return transform;
}

void FloatGrid::set_affine(rust::Slice<const double> matrix) { impl->grid->setTransform(linear_transform(matrix)); }
void FloatGrid::set_name(rust::Str name) { impl->grid->setName(std::string(name)); }
void FloatGrid::set_creator(rust::Str creator) { impl->grid->setCreator(std::string(creator)); }

void FloatGrid::set_half(bool half)
{
    // Not unless it changes: it adds an item to the metadata.
    if (half != impl->grid->saveFloatAsHalf()) impl->grid->setSaveFloatAsHalf(half);
}

} // namespace vdb_edit
