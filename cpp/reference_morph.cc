// OpenVDB's morphing and fast sweeping, as a second opinion on ours. Apart from reference.cc because they instantiate as
// much again.

#include "internal.h"

#include <openvdb/tools/FastSweeping.h>
#include <openvdb/tools/LevelSetMorph.h>

namespace vdb_edit {

namespace {

openvdb::math::BiasedGradientScheme spatial(bool weno5)
{
    return weno5 ? openvdb::math::HJWENO5_BIAS : openvdb::math::FIRST_BIAS;
}

openvdb::math::TemporalIntegrationScheme temporal(std::uint32_t runge_kutta)
{
    return runge_kutta == 3 ? openvdb::math::TVD_RK3
        : runge_kutta == 2  ? openvdb::math::TVD_RK2
                            : openvdb::math::TVD_RK1;
}

} // namespace

std::size_t morph(FloatGrid& grid, const FloatGrid& target, float time, bool weno5, std::uint32_t runge_kutta,
    const TrackerOptions& tracker)
{
    const QuietOutput scope;
    grid.impl->leaves.clear();
    openvdb::tools::LevelSetMorphing<openvdb::FloatGrid> morphing(*grid.impl->grid, *target.impl->grid);
    morphing.setSpatialScheme(spatial(weno5));
    morphing.setTemporalScheme(temporal(runge_kutta));
    morphing.setTrackerSpatialScheme(spatial(tracker.weno5));
    morphing.setTrackerTemporalScheme(temporal(tracker.runge_kutta));
    morphing.setNormCount(static_cast<int>(tracker.normalizations));
    return morphing.advect(0.0f, time);
}

std::unique_ptr<FloatGrid> sdf_to_sdf(const FloatGrid& grid, std::int32_t iterations)
{
    const QuietOutput scope;
    return wrap(openvdb::tools::sdfToSdf(*grid.impl->grid, 0.0f, iterations));
}

std::unique_ptr<FloatGrid> dilate_sdf(const FloatGrid& grid, std::int32_t voxels, std::int32_t iterations)
{
    const QuietOutput scope;
    return wrap(openvdb::tools::dilateSdf(*grid.impl->grid, voxels, openvdb::tools::NN_FACE, iterations));
}

} // namespace vdb_edit
