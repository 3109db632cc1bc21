// Saves the grids of a file in another way, for read_vs_openvdb.sh and write_vs_openvdb.sh beside this file.
//
//   openvdb_resave IN.vdb OUT.vdb blosc|zip|none full|half
//
// The class of each grid becomes "unknown", since OpenVDB does not zip fog volumes and level sets.

#include <openvdb/io/File.h>
#include <openvdb/openvdb.h>

#include <cstdio>
#include <exception>
#include <string>

int main(int argc, char** argv)
{
    if (argc != 5) {
        std::fprintf(stderr, "usage: openvdb_resave IN.vdb OUT.vdb blosc|zip|none full|half\n");
        return 2;
    }
    try {
        openvdb::initialize();
        openvdb::io::File in(argv[1]);
        in.open(/*delayLoad=*/false);
        const openvdb::GridPtrVecPtr grids = in.getGrids();
        const std::string codec = argv[3];
        uint32_t flags = openvdb::io::COMPRESS_ACTIVE_MASK;
        if (codec == "blosc") flags |= openvdb::io::COMPRESS_BLOSC;
        if (codec == "zip") flags |= openvdb::io::COMPRESS_ZIP;
        for (const auto& grid : *grids) {
            grid->setGridClass(openvdb::GRID_UNKNOWN);
            grid->setSaveFloatAsHalf(std::string(argv[4]) == "half");
        }
        openvdb::io::File out(argv[2]);
        out.setCompression(flags);
        out.write(*grids);
        out.close();
        return 0;
    } catch (const std::exception& error) {
        std::fprintf(stderr, "openvdb_resave: %s\n", error.what());
        return 1;
    }
}
