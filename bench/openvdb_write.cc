// Times OpenVDB writing every grid of a file, for write_vs_openvdb.sh beside this file.
//
//   openvdb_write FILE blosc|zip|none full|half REPEATS FOLDER
//
// writes to a file in FOLDER, which should be in memory (/dev/shm), and prints one line: median_ms=... min_ms=...
// grids=... active_voxels=... bytes=... Grids are read whole before; their class is set to unknown, since OpenVDB does
// not zip fog volumes and level sets.

#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <fstream>
#include <string>
#include <unistd.h>
#include <vector>

namespace {

using Milliseconds = std::chrono::duration<double, std::milli>;

double median(std::vector<double> sorted)
{
    const size_t middle = sorted.size() / 2;
    return sorted.size() % 2 ? sorted[middle] : 0.5 * (sorted[middle - 1] + sorted[middle]);
}

uint32_t compressionFlags(const std::string& name)
{
    const uint32_t activeMask = openvdb::io::COMPRESS_ACTIVE_MASK;
    if (name == "blosc") return openvdb::io::COMPRESS_BLOSC | activeMask;
    if (name == "zip") return openvdb::io::COMPRESS_ZIP | activeMask;
    return activeMask;
}

int run(const std::string& path, const std::string& compression, bool half, int repeats, const std::string& folder)
{
    openvdb::initialize();
    openvdb::io::File input(path);
    input.open(/*delayLoad=*/false);
    const openvdb::GridPtrVecPtr grids = input.getGrids();
    input.close();
    openvdb::Index64 activeVoxels = 0;
    for (const auto& grid : *grids) {
        grid->setSaveFloatAsHalf(half);
        grid->setGridClass(openvdb::GRID_UNKNOWN);
        activeVoxels += grid->activeVoxelCount();
    }
    const std::string target = folder + "/openvdb_write." + std::to_string(getpid()) + ".vdb";
    std::vector<double> times;
    for (int turn = 0; turn < repeats; ++turn) {
        const auto begin = std::chrono::steady_clock::now();
        openvdb::io::File output(target);
        output.setCompression(compressionFlags(compression));
        output.write(*grids);
        output.close();
        times.push_back(Milliseconds(std::chrono::steady_clock::now() - begin).count());
    }
    const long long bytes = std::ifstream(target, std::ios::ate | std::ios::binary).tellg();
    std::remove(target.c_str());
    std::sort(times.begin(), times.end());
    std::printf("median_ms=%.3f min_ms=%.3f grids=%zu active_voxels=%llu bytes=%lld\n", median(times), times.front(),
                grids->size(), static_cast<unsigned long long>(activeVoxels), bytes);
    return 0;
}

} // namespace

int main(int argc, char** argv)
{
    const int repeats = argc == 6 ? std::atoi(argv[4]) : 0;
    if (repeats < 1) {
        std::fprintf(stderr, "usage: openvdb_write FILE blosc|zip|none full|half REPEATS FOLDER\n");
        return 2;
    }
    try {
        return run(argv[1], argv[2], std::string(argv[3]) == "half", repeats, argv[5]);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "openvdb_write: %s: %s\n", argv[1], error.what());
        return 1;
    }
}
