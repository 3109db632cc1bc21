// Times OpenVDB reading every grid of a file into memory, for read_vs_openvdb.sh beside this file.
//
//   openvdb_read FILE REPEATS
//
// prints one line: median_ms=... min_ms=... grids=... active_voxels=... compression=... (the rest of the line).
// Delayed loading is off, so all leaf values are decoded. Opening the file is timed; freeing the grids is not.

#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <set>
#include <string>
#include <vector>

namespace {

using Milliseconds = std::chrono::duration<double, std::milli>;

openvdb::GridPtrVecPtr readAllGrids(const std::string& path)
{
    openvdb::io::File file(path);
    file.open(/*delayLoad=*/false);
    openvdb::GridPtrVecPtr grids = file.getGrids();
    file.close();
    return grids;
}

// What OpenVDB says of each grid's storage, joined where grids differ: "blosc + active values, half".
std::string describeCompression(const openvdb::GridPtrVec& grids)
{
    std::set<std::string> kinds;
    for (const auto& grid : grids) {
        const auto stored = grid->getMetadata<openvdb::StringMetadata>(openvdb::GridBase::META_FILE_COMPRESSION);
        std::string kind = stored ? stored->value() : "unknown";
        if (grid->saveFloatAsHalf()) kind += ", half";
        kinds.insert(kind);
    }
    std::string joined;
    for (const auto& kind : kinds) joined += (joined.empty() ? "" : "; ") + kind;
    return joined;
}

double median(std::vector<double> sorted)
{
    const size_t middle = sorted.size() / 2;
    return sorted.size() % 2 ? sorted[middle] : 0.5 * (sorted[middle - 1] + sorted[middle]);
}

int run(const std::string& path, int repeats)
{
    openvdb::initialize();
    std::vector<double> times;
    size_t gridCount = 0;
    openvdb::Index64 activeVoxels = 0;
    std::string compression;
    for (int turn = 0; turn < repeats; ++turn) {
        const auto begin = std::chrono::steady_clock::now();
        const openvdb::GridPtrVecPtr grids = readAllGrids(path);
        times.push_back(Milliseconds(std::chrono::steady_clock::now() - begin).count());
        if (turn > 0) continue;
        gridCount = grids->size();
        for (const auto& grid : *grids) activeVoxels += grid->activeVoxelCount();
        compression = describeCompression(*grids);
    }
    std::sort(times.begin(), times.end());
    std::printf("median_ms=%.3f min_ms=%.3f grids=%zu active_voxels=%llu compression=%s\n", median(times),
                times.front(), gridCount, static_cast<unsigned long long>(activeVoxels), compression.c_str());
    return 0;
}

} // namespace

int main(int argc, char** argv)
{
    const int repeats = argc == 3 ? std::atoi(argv[2]) : 0;
    if (repeats < 1) {
        std::fprintf(stderr, "usage: openvdb_read FILE REPEATS\n");
        return 2;
    }
    try {
        return run(argv[1], repeats);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "openvdb_read: %s: %s\n", argv[1], error.what());
        return 1;
    }
}
