// Grids of vectors, component by component: what `Leaves` says of scalar grids, without nodes, and grids of three scalar ones.

#include "internal.h"

#include <algorithm>

namespace vdb_edit {

namespace {

/// One component of the leaves of a tree of Vec3f or Vec3d.
template<typename GridT>
class ComponentOf final : public Leaves::Impl {
    using TreeT = typename GridT::TreeType;
    using LeafT = typename TreeT::LeafNodeType;
    using Upper = typename TreeT::RootNodeType::ChildNodeType;
    using Lower = typename Upper::ChildNodeType;

public:
    ComponentOf(typename GridT::ConstPtr grid, int component) : grid_(std::move(grid)), component_(component)
    {
        const TreeT& tree = grid_->tree();
        tree.getNodes(leaves_);
        tree.getNodes(lower_);
        tree.getNodes(upper_);
    }

    std::size_t count() const override { return leaves_.size(); }
    double background() const override { return static_cast<double>(grid_->background()[component_]); }
    void origins(rust::Slice<std::int32_t> out) const override { write_origins(leaves_, out); }

    void copy(std::size_t first, rust::Slice<float> values, rust::Slice<std::uint64_t> masks) const override
    {
        const std::size_t n = values.size() / kLeafVoxels;
        require(values.size() == n * kLeafVoxels && masks.size() == n * kMaskWords, "copy: wrong length");
        require(first <= leaves_.size() && n <= leaves_.size() - first, "copy: leaves out of range");
        for (std::size_t i = 0; i < n; ++i) {
            const LeafT& leaf = *leaves_[first + i];
            const auto* source = leaf.buffer().data();
            std::transform(source, source + kLeafVoxels, values.data() + i * kLeafVoxels,
                [this](const auto& v) { return static_cast<float>(v[component_]); });
            for (std::size_t w = 0; w < kMaskWords; ++w) {
                masks[i * kMaskWords + w] = leaf.getValueMask().template getWord<std::uint64_t>(openvdb::Index(w));
            }
        }
    }

    std::size_t node_count() const override { return 0; }
    void node_origins(rust::Slice<std::int32_t>) const override {}
    void node_inside(rust::Slice<std::uint64_t>) const override {}

    void tiles(rust::Vec<Tile>& out) const override
    {
        const auto add = [&](const auto& it, std::uint32_t size) {
            const openvdb::Coord at = it.getCoord();
            const auto value = static_cast<float>(it.getValue()[component_]);
            if (it.isValueOn()) out.push_back(Tile{at.x(), at.y(), at.z(), size, value, true});
        };
        for (const Lower* node : lower_) {
            for (auto it = node->cbeginValueOn(); it; ++it) add(it, 8);
        }
        for (const Upper* node : upper_) {
            for (auto it = node->cbeginValueOn(); it; ++it) add(it, 128);
        }
        for (auto it = grid_->tree().root().cbeginValueOn(); it; ++it) add(it, 4096);
    }

    void inactive_tile_range(double& low, double& high) const override { low = high = background(); }

private:
    typename GridT::ConstPtr grid_;
    int component_;
    std::vector<const LeafT*> leaves_;
    std::vector<const Lower*> lower_;
    std::vector<const Upper*> upper_;
};

} // namespace

std::unique_ptr<Leaves> component_of(const openvdb::GridBase::ConstPtr& grid, std::uint32_t component)
{
    require(component < 3, "a vector has components 0 to 2");
    const int c = static_cast<int>(component);
    if (const auto floats = openvdb::gridConstPtrCast<openvdb::Vec3SGrid>(grid)) {
        return std::make_unique<Leaves>(std::make_unique<ComponentOf<openvdb::Vec3SGrid>>(floats, c));
    }
    if (const auto doubles = openvdb::gridConstPtrCast<openvdb::Vec3DGrid>(grid)) {
        return std::make_unique<Leaves>(std::make_unique<ComponentOf<openvdb::Vec3DGrid>>(doubles, c));
    }
    throw std::invalid_argument("a grid of type " + grid->type() + " holds no vectors of three numbers");
}

openvdb::GridBase::Ptr vectors_of(const FloatGrid& x, const FloatGrid& y, const FloatGrid& z)
{
    using TreeT = openvdb::Vec3STree;
    using LeafT = TreeT::LeafNodeType;
    auto grid = openvdb::gridPtrCast<openvdb::Vec3SGrid>(openvdb::GridBase::createGrid("Tree_vec3s_5_4_3"));
    if (!grid) throw std::runtime_error("OpenVDB does not know its own vector grids");
    require(x.impl->lent.empty() && y.impl->lent.empty() && z.impl->lent.empty(), "components are copied, not lent");
    const std::vector<LeafNode*>* parts[3] = {&x.impl->leaves, &y.impl->leaves, &z.impl->leaves};
    require(parts[0]->size() == parts[1]->size() && parts[0]->size() == parts[2]->size(), "components differ in their leaves");
    openvdb::tree::ValueAccessor<TreeT> accessor(grid->tree());
    for (std::size_t i = 0; i < parts[0]->size(); ++i) {
        const LeafNode* of[3] = {(*parts[0])[i], (*parts[1])[i], (*parts[2])[i]};
        require(of[0]->origin() == of[1]->origin() && of[0]->origin() == of[2]->origin(), "components differ in their leaves");
        auto leaf = std::make_unique<LeafT>(of[0]->origin(), openvdb::Vec3f(0.0f), false);
        for (openvdb::Index v = 0; v < openvdb::Index(kLeafVoxels); ++v) {
            leaf->setValueOnly(v, openvdb::Vec3f(of[0]->getValue(v), of[1]->getValue(v), of[2]->getValue(v)));
        }
        leaf->setValueMask(of[0]->getValueMask());
        accessor.addLeaf(leaf.release());
    }
    const openvdb::FloatGrid& like = *x.impl->grid;
    for (auto it = like.beginMeta(); it != like.endMeta(); ++it) grid->insertMeta(it->first, *it->second);
    grid->setTransform(like.transform().copy());
    return grid;
}

} // namespace vdb_edit
