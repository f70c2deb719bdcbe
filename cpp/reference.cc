// OpenVDB's own tools, as a second opinion on ours. Compiles in 22 s at -O3 (9 s at -O1): most of the work is in
// instantiations that libopenvdb holds already. Morphing and fast sweeping are in reference_morph.cc.

#include "internal.h"

#include <openvdb/tools/Composite.h>
#include <openvdb/tools/LevelSetFilter.h>
#include <openvdb/tools/LevelSetMeasure.h>
#include <openvdb/tools/LevelSetRebuild.h>
#include <openvdb/tools/MeshToVolume.h>
#include <openvdb/tools/VolumeToMesh.h>

#include <algorithm>
#include <stdexcept>

namespace vdb_edit {

namespace {

/// Runs `work` on a filter of `grid` that is set up as `options` say.
template<typename Work>
void with_filter(FloatGrid& grid, const TrackerOptions& options, Work work)
{
    const QuietOutput scope;
    // The tools add and remove leaves: the list made while building is void from here on.
    grid.impl->leaves.clear();
    openvdb::tools::LevelSetFilter<openvdb::FloatGrid> filter(*grid.impl->grid);
    filter.setSpatialScheme(options.weno5 ? openvdb::math::HJWENO5_BIAS : openvdb::math::FIRST_BIAS);
    filter.setTemporalScheme(options.runge_kutta == 3 ? openvdb::math::TVD_RK3
            : options.runge_kutta == 2                ? openvdb::math::TVD_RK2
                                                      : openvdb::math::TVD_RK1);
    filter.setNormCount(static_cast<int>(options.normalizations));
    work(filter);
}

/// A grid like `like` around `tree`.
std::unique_ptr<FloatGrid> with_tree(const FloatGrid& like, const openvdb::FloatTree::Ptr& tree)
{
    auto grid = make_float_grid(static_cast<double>(tree->background()));
    grid->insertMeta(*like.impl->grid);
    grid->setTransform(like.impl->grid->transformPtr());
    grid->setTree(tree);
    return wrap(std::move(grid));
}

} // namespace

std::unique_ptr<FloatGrid> copy_grid(const FloatGrid& grid)
{
    return wrap(openvdb::gridPtrCast<openvdb::FloatGrid>(grid.impl->grid->deepCopyGrid()));
}

void filter_mean_curvature(FloatGrid& grid, std::size_t steps, const TrackerOptions& options)
{
    with_filter(grid, options, [steps](auto& filter) {
        for (std::size_t i = 0; i < steps; ++i) filter.meanCurvature();
    });
}

void filter_mean_curvature_masked(FloatGrid& grid, const FloatGrid& mask, const TrackerOptions& options)
{
    with_filter(grid, options, [&mask](auto& filter) {
        filter.setMaskRange(0.0f, 1.0f);
        filter.meanCurvature(mask.impl->grid.get());
    });
}

void filter_laplacian(FloatGrid& grid, std::size_t steps, const TrackerOptions& options)
{
    with_filter(grid, options, [steps](auto& filter) {
        for (std::size_t i = 0; i < steps; ++i) filter.laplacian();
    });
}

void filter_gaussian(FloatGrid& grid, std::int32_t width, const TrackerOptions& options)
{
    with_filter(grid, options, [width](auto& filter) { filter.gaussian(width); });
}

void filter_mean(FloatGrid& grid, std::int32_t width, const TrackerOptions& options)
{
    with_filter(grid, options, [width](auto& filter) { filter.mean(width); });
}

void filter_median(FloatGrid& grid, std::int32_t width, const TrackerOptions& options)
{
    with_filter(grid, options, [width](auto& filter) { filter.median(width); });
}

void filter_offset(FloatGrid& grid, float distance, const TrackerOptions& options)
{
    // OpenVDB's offset adds to the values: positive erodes.
    with_filter(grid, options, [distance](auto& filter) { filter.offset(-distance); });
}

void track(FloatGrid& grid, const TrackerOptions& options)
{
    with_filter(grid, options, [](auto& filter) { filter.track(); });
}

void normalize(FloatGrid& grid, const TrackerOptions& options)
{
    with_filter(grid, options, [](auto& filter) { filter.normalize(); });
}

std::unique_ptr<FloatGrid> csg_union(const FloatGrid& a, const FloatGrid& b)
{
    return with_tree(a, openvdb::tools::csgUnionCopy(a.impl->grid->tree(), b.impl->grid->tree()));
}

std::unique_ptr<FloatGrid> csg_intersection(const FloatGrid& a, const FloatGrid& b)
{
    return with_tree(a, openvdb::tools::csgIntersectionCopy(a.impl->grid->tree(), b.impl->grid->tree()));
}

std::unique_ptr<FloatGrid> csg_difference(const FloatGrid& a, const FloatGrid& b)
{
    return with_tree(a, openvdb::tools::csgDifferenceCopy(a.impl->grid->tree(), b.impl->grid->tree()));
}

std::unique_ptr<FloatGrid> level_set_rebuild(const FloatGrid& grid, float iso, float half_width)
{
    const QuietOutput scope;
    return wrap(openvdb::tools::levelSetRebuild(*grid.impl->grid, iso, half_width));
}

std::unique_ptr<FloatGrid> mesh_to_level_set(rust::Slice<const float> points, rust::Slice<const std::uint32_t> triangles,
    rust::Slice<const double> matrix, float half_width, bool renormalize)
{
    const QuietOutput scope;
    initialize();
    std::vector<openvdb::Vec3s> vertices(points.size() / 3);
    for (std::size_t i = 0; i < vertices.size(); ++i) {
        vertices[i] = openvdb::Vec3s(points[i * 3], points[i * 3 + 1], points[i * 3 + 2]);
    }
    std::vector<openvdb::Vec3I> faces(triangles.size() / 3);
    for (std::size_t i = 0; i < faces.size(); ++i) {
        faces[i] = openvdb::Vec3I(triangles[i * 3], triangles[i * 3 + 1], triangles[i * 3 + 2]);
        for (int c = 0; c < 3; ++c) {
            if (faces[i][c] >= vertices.size()) throw std::out_of_range("a triangle names a vertex that is not there");
        }
    }
    const auto transform = linear_transform(matrix);
    if (renormalize) {
        return wrap(openvdb::tools::meshToLevelSet<openvdb::FloatGrid>(*transform, vertices, faces, half_width));
    }
    for (auto& vertex : vertices) vertex = openvdb::Vec3s(transform->worldToIndex(vertex));
    const openvdb::tools::QuadAndTriangleDataAdapter<openvdb::Vec3s, openvdb::Vec3I> mesh(vertices, faces);
    return wrap(openvdb::tools::meshToVolume<openvdb::FloatGrid>(mesh, *transform, half_width, half_width,
        openvdb::tools::DISABLE_RENORMALIZATION | openvdb::tools::DISABLE_INTERSECTING_VOXEL_REMOVAL));
}

struct RawMesh::Impl {
    std::vector<openvdb::Vec3s> points;
    std::vector<openvdb::Vec3I> triangles;
    std::vector<openvdb::Vec4I> quads;
};

RawMesh::RawMesh(std::unique_ptr<Impl> i) : impl(std::move(i)) {}
RawMesh::~RawMesh() = default;

namespace {

template<typename T, typename V>
void flatten(const std::vector<V>& from, rust::Slice<T> out)
{
    if (out.size() != from.size() * V::size) throw std::invalid_argument("wrong length");
    std::size_t i = 0;
    for (const V& v : from) {
        for (int c = 0; c < V::size; ++c) out[i++] = v[c];
    }
}

} // namespace

std::size_t RawMesh::point_count() const { return impl->points.size(); }
std::size_t RawMesh::triangle_count() const { return impl->triangles.size(); }
std::size_t RawMesh::quad_count() const { return impl->quads.size(); }
void RawMesh::points(rust::Slice<float> out) const { flatten(impl->points, out); }
void RawMesh::triangles(rust::Slice<std::uint32_t> out) const { flatten(impl->triangles, out); }
void RawMesh::quads(rust::Slice<std::uint32_t> out) const { flatten(impl->quads, out); }

std::unique_ptr<RawMesh> volume_to_mesh(const FloatGrid& grid, double iso, double adaptivity)
{
    const QuietOutput scope;
    auto mesh = std::make_unique<RawMesh::Impl>();
    openvdb::tools::volumeToMesh(*grid.impl->grid, mesh->points, mesh->triangles, mesh->quads, iso, adaptivity);
    return std::make_unique<RawMesh>(std::move(mesh));
}

double level_set_area(const FloatGrid& grid) { return openvdb::tools::levelSetArea(*grid.impl->grid); }
double level_set_volume(const FloatGrid& grid) { return openvdb::tools::levelSetVolume(*grid.impl->grid); }

} // namespace vdb_edit
