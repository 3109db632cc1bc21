// NanoVDB's side of rays_vs_nanovdb.sh: one kernel over all pixels of a picture, timed.
//
//   nanovdb_rays FILE.nvdb KERNEL THREADS REPEATS [SIZE [PICTURE.f32 [SEED]]]
//
// prints one line: median_ms=... min_ms=... cpu_ms=... mean=... look_ups=... (per ray, 0 where not counted). Reading the file is not
// timed, and one picture is made before the first that is. PICTURE.f32 receives the values row by row.
//
// Rays live in index space: pinhole, 45 degrees, on the box's axis along z, two depths of the box before its centre, one ray
// through each pixel's centre. Kernels (extinction is EXTINCTION per voxel at density 1):
//
//   nearest, nearest-spans        opacity; a look-up every half voxel in the whole box, or only where there are leaves
//   trilinear, trilinear-spans    the same with interpolated values
//   exact, exact-spans            opacity by the length of the ray in every voxel: HDDA with an accessor, or a DDA per leaf
//   cubic, cubic-spans            the same for interpolated values, whose integral over a cell Simpson's rule gives exactly
//   track, track-spans            1 if a path collides, by delta tracking with the grid's maximum as majorant
//   surface, surface-shaded       distance to the first change of sign; the cosine to the normal there
//
// Spans are what NanoVDB's TreeMarcher yields.

#include <nanovdb/NanoVDB.h>
#include <nanovdb/util/HDDA.h>
#include <nanovdb/util/IO.h>
#include <nanovdb/util/Ray.h>
#include <nanovdb/util/SampleFromVoxels.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <exception>
#include <fstream>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace {

using Coord = nanovdb::Coord;
using Grid = nanovdb::FloatGrid;
using Accessor = Grid::AccessorType;
using Leaf = nanovdb::NanoLeaf<float>;
using Vec3 = nanovdb::Vec3<float>;
using Ray = nanovdb::Ray<float>;
using Marcher = nanovdb::TreeMarcher<Leaf, Ray, Accessor>;

constexpr float EXTINCTION = 0.1f;
constexpr float STEP = 0.5f;
constexpr int TILE = 16;

struct Scene
{
    const Grid* grid;
    nanovdb::CoordBBox box;
    Vec3 eye;
    float halfWidth; // Tangent of half the field of view.
    int size;
    uint32_t seed;

    Ray ray(int x, int y) const
    {
        const float u = (2 * (x + 0.5f) / size - 1) * halfWidth, v = (1 - 2 * (y + 0.5f) / size) * halfWidth;
        Vec3 direction(u, v, -1);
        direction.normalize();
        return Ray(eye, direction);
    }
};

struct Pixel
{
    float value = 0;
    uint32_t lookUps = 0;
};

Coord cellOf(const Vec3& p) { return nanovdb::RoundDown<Coord>(p); }

// The first whole multiple of the step that is not less than t.
float onLattice(float t) { return std::ceil(t / STEP) * STEP; }

// Light through a stretch of the ray with a sample at each multiple of the step.
template<typename Value>
void march(const Ray& ray, float t0, float t1, const Value& value, float& transmittance, Pixel& pixel)
{
    for (float t = onLattice(t0); t < t1; t += STEP) {
        transmittance *= 1 - EXTINCTION * STEP * value(ray(t));
        ++pixel.lookUps;
    }
}

template<typename Value>
Pixel marchBox(const Scene& scene, Ray ray, const Value& value)
{
    Pixel pixel;
    if (!ray.clip(scene.box)) return pixel;
    float transmittance = 1;
    march(ray, ray.t0(), ray.t1(), value, transmittance, pixel);
    pixel.value = 1 - transmittance;
    return pixel;
}

// Calls back with each leaf and the stretch of the ray in it.
template<typename Span>
void eachSpan(Accessor& accessor, const Ray& ray, const Span& span)
{
    Marcher marcher(accessor);
    if (!marcher.init(ray)) return;
    const Leaf* leaf;
    float t0, t1;
    while (marcher.step(&leaf, t0, t1)) span(*leaf, t0, t1);
}

Pixel nearestSpans(Accessor& accessor, const Ray& ray)
{
    Pixel pixel;
    float transmittance = 1;
    eachSpan(accessor, ray, [&](const Leaf& leaf, float t0, float t1) {
        march(ray, t0, t1, [&](const Vec3& p) { return leaf.getValue(cellOf(p)); }, transmittance, pixel);
    });
    pixel.value = 1 - transmittance;
    return pixel;
}

template<typename Sampler>
Pixel trilinearSpans(Accessor& accessor, const Sampler& sampler, const Ray& ray)
{
    Pixel pixel;
    float transmittance = 1;
    eachSpan(accessor, ray, [&](const Leaf&, float t0, float t1) {
        march(ray, t0, t1, sampler, transmittance, pixel);
    });
    pixel.value = 1 - transmittance;
    return pixel;
}

// The integral of a cubic over a stretch, by Simpson's rule.
template<typename Sampler>
float cubicIntegral(const Sampler& sampler, const Ray& ray, float t0, float t1)
{
    return (t1 - t0) / 6 * (sampler(ray(t0)) + 4 * sampler(ray(0.5f * (t0 + t1))) + sampler(ray(t1)));
}

// Integrates over the voxels that the ray crosses, `integral` giving each one's share: an HDDA over the whole tree.
template<typename Integral>
Pixel exactInTree(const Scene& scene, Accessor& accessor, Ray ray, const Integral& integral)
{
    Pixel pixel;
    if (!ray.clip(scene.box)) return pixel;
    Coord voxel = cellOf(ray.start());
    nanovdb::HDDA<Ray, Coord> hdda(ray, accessor.getDim(voxel, ray));
    float depth = 0;
    for (;;) {
        const float t0 = hdda.time(), t1 = std::min(hdda.next(), ray.t1());
        if (hdda.dim() == 1) depth += integral(voxel, t0, t1);
        ++pixel.lookUps;
        if (!hdda.step()) break;
        voxel = cellOf(ray(hdda.time() + 1e-3f));
        hdda.update(ray, accessor.getDim(voxel, ray));
        if (hdda.dim() == 1) voxel = hdda.voxel();
    }
    pixel.value = 1 - std::exp(-EXTINCTION * depth);
    return pixel;
}

// The same with a DDA over the voxels of one leaf after another.
template<typename Integral>
Pixel exactInLeaves(Accessor& accessor, const Ray& ray, const Integral& integral)
{
    Pixel pixel;
    float depth = 0;
    eachSpan(accessor, ray, [&](const Leaf& leaf, float t0, float t1) {
        nanovdb::DDA<Ray, Coord, 1> dda;
        const float start = t0 + 1e-4f; // Inside the first voxel, whatever rounding did.
        if (start >= t1) return;
        dda.init(ray, start, t1);
        float from = t0;
        bool inside = true;
        while (inside) {
            const float to = std::min(dda.next(), t1);
            depth += integral(leaf, dda.voxel(), from, to);
            ++pixel.lookUps;
            from = to;
            inside = dda.step();
        }
    });
    pixel.value = 1 - std::exp(-EXTINCTION * depth);
    return pixel;
}

// Random numbers of one pixel (PCG).
struct Random
{
    uint32_t state;

    float unit()
    {
        state = state * 747796405u + 2891336453u;
        uint32_t word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737u;
        word = (word >> 22) ^ word;
        return static_cast<float>(word >> 8) * (1.0f / 16777216.0f);
    }

    float depth() { return -std::log(1 - unit()); }
};

template<typename Sampler>
Pixel trackBox(const Scene& scene, const Sampler& sampler, Ray ray, Random random)
{
    Pixel pixel;
    if (!ray.clip(scene.box)) return pixel;
    const float majorant = scene.grid->tree().root().maximum() * EXTINCTION, perMajorant = 1 / majorant;
    for (float t = ray.t0() + random.depth() * perMajorant; t < ray.t1(); t += random.depth() * perMajorant) {
        ++pixel.lookUps;
        if (sampler(ray(t)) * EXTINCTION > random.unit() * majorant) {
            pixel.value = 1;
            break;
        }
    }
    return pixel;
}

template<typename Sampler>
Pixel trackSpans(const Scene& scene, Accessor& accessor, const Sampler& sampler, const Ray& ray, Random random)
{
    Pixel pixel;
    Marcher marcher(accessor);
    if (!marcher.init(ray)) return pixel;
    const float majorant = scene.grid->tree().root().maximum() * EXTINCTION, perMajorant = 1 / majorant;
    float left = random.depth() * perMajorant;
    const Leaf* leaf;
    float t0, t1;
    while (marcher.step(&leaf, t0, t1)) {
        while (left < t1 - t0) {
            t0 += left;
            ++pixel.lookUps;
            if (sampler(ray(t0)) * EXTINCTION > random.unit() * majorant) {
                pixel.value = 1;
                return pixel;
            }
            left = random.depth() * perMajorant;
        }
        left -= t1 - t0;
    }
    return pixel;
}

Pixel surface(Accessor& accessor, Ray ray, bool isShaded)
{
    Pixel pixel;
    Coord voxel;
    float value, t;
    if (!nanovdb::ZeroCrossing(ray, accessor, voxel, value, t)) return pixel;
    pixel.value = t;
    if (isShaded) {
        const auto difference = [&](const Coord& step) {
            return accessor.getValue(voxel + step) - accessor.getValue(voxel - step);
        };
        Vec3 normal(difference(Coord(1, 0, 0)), difference(Coord(0, 1, 0)), difference(Coord(0, 0, 1)));
        normal.normalize();
        pixel.value = std::abs(normal.dot(ray.dir()));
    }
    return pixel;
}

// Fills the picture, tile by tile. `makeKernel` gives each thread its own (an accessor is not shared).
template<typename MakeKernel>
void render(int threads, int size, const MakeKernel& makeKernel, std::vector<Pixel>& picture)
{
    const int columns = (size + TILE - 1) / TILE;
    std::atomic<int> next{0};
    const auto work = [&] {
        auto kernel = makeKernel();
        for (int tile = next++; tile < columns * columns; tile = next++) {
            const int left = tile % columns * TILE, top = tile / columns * TILE;
            for (int y = top; y < std::min(top + TILE, size); ++y)
                for (int x = left; x < std::min(left + TILE, size); ++x)
                    picture[static_cast<size_t>(y) * size + x] = kernel(x, y);
        }
    };
    std::vector<std::thread> others;
    for (int i = 1; i < threads; ++i) others.emplace_back(work);
    work();
    for (auto& other : others) other.join();
}

struct Timing
{
    int threads, repeats;
    std::vector<double> times, cpuTimes;
};

double median(std::vector<double> values)
{
    if (values.empty()) throw std::runtime_error("nothing was timed");
    std::sort(values.begin(), values.end());
    return 0.5 * (values[values.size() / 2] + values[(values.size() - 1) / 2]);
}

template<typename MakeKernel>
std::vector<Pixel> timed(const Scene& scene, Timing& timing, const MakeKernel& makeKernel)
{
    std::vector<Pixel> picture(static_cast<size_t>(scene.size) * scene.size);
    for (int turn = 0; turn <= timing.repeats; ++turn) {
        const auto begin = std::chrono::steady_clock::now();
        const std::clock_t cpuBegin = std::clock();
        render(timing.threads, scene.size, makeKernel, picture);
        const std::chrono::duration<double, std::milli> time = std::chrono::steady_clock::now() - begin;
        if (turn == 0) continue;
        timing.times.push_back(time.count());
        timing.cpuTimes.push_back(1e3 * (std::clock() - cpuBegin) / CLOCKS_PER_SEC);
    }
    return picture;
}

std::vector<Pixel> run(const std::string& kernel, const Scene& scene, Timing& timing)
{
    const Grid& grid = *scene.grid;
    // Per thread an accessor, which the sampler refers to, so that both are made on the spot.
    const auto with = [&](const auto& body) {
        return timed(scene, timing, [&] {
            return [&scene, &body, accessor = grid.getAccessor()](int x, int y) mutable {
                return body(accessor, scene.ray(x, y), x, y);
            };
        });
    };
    const auto random = [&](int x, int y) {
        return Random{(static_cast<uint32_t>(y) * scene.size + x) * 9781u + scene.seed * 0x9e3779b9u + 1};
    };
    if (kernel == "nearest")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return marchBox(scene, ray, [&](const Vec3& p) { return a.getValue(cellOf(p)); });
        });
    if (kernel == "nearest-spans")
        return with([&](Accessor& a, const Ray& ray, int, int) { return nearestSpans(a, ray); });
    if (kernel == "trilinear")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return marchBox(scene, ray, nanovdb::createSampler<1>(a));
        });
    if (kernel == "trilinear-spans")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return trilinearSpans(a, nanovdb::createSampler<1>(a), ray);
        });
    if (kernel == "exact")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return exactInTree(scene, a, ray, [&](const Coord& voxel, float t0, float t1) {
                return a.getValue(voxel) * (t1 - t0);
            });
        });
    if (kernel == "exact-spans")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return exactInLeaves(a, ray, [&](const Leaf& leaf, const Coord& voxel, float t0, float t1) {
                return leaf.getValue(voxel) * (t1 - t0);
            });
        });
    if (kernel == "cubic")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            const auto sampler = nanovdb::createSampler<1>(a);
            return exactInTree(scene, a, ray, [&](const Coord&, float t0, float t1) {
                return cubicIntegral(sampler, ray, t0, t1);
            });
        });
    if (kernel == "cubic-spans")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            const auto sampler = nanovdb::createSampler<1>(a);
            return exactInLeaves(a, ray, [&](const Leaf&, const Coord&, float t0, float t1) {
                return cubicIntegral(sampler, ray, t0, t1);
            });
        });
    if (kernel == "track")
        return with([&](Accessor& a, const Ray& ray, int x, int y) {
            return trackBox(scene, nanovdb::createSampler<1>(a), ray, random(x, y));
        });
    if (kernel == "track-spans")
        return with([&](Accessor& a, const Ray& ray, int x, int y) {
            return trackSpans(scene, a, nanovdb::createSampler<1>(a), ray, random(x, y));
        });
    if (kernel == "surface" || kernel == "surface-shaded")
        return with([&](Accessor& a, const Ray& ray, int, int) {
            return surface(a, ray, kernel == "surface-shaded");
        });
    throw std::runtime_error("no kernel '" + kernel + "'");
}

int main2(int count, char** arguments)
{
    if (count < 5) throw std::runtime_error("usage: nanovdb_rays FILE.nvdb KERNEL THREADS REPEATS [SIZE [PICTURE [SEED]]]");
    const auto handle = nanovdb::io::readGrid(arguments[1]);
    const Grid* grid = handle.grid<float>();
    if (!grid) throw std::runtime_error("no grid of floats");
    Scene scene{};
    scene.grid = grid;
    scene.box = grid->tree().bbox();
    scene.size = count > 5 ? std::atoi(arguments[5]) : 1024;
    scene.seed = count > 7 ? std::atoi(arguments[7]) : 0;
    scene.halfWidth = std::tan(0.125f * 3.14159265f);
    const Vec3 low(scene.box.min()[0], scene.box.min()[1], scene.box.min()[2]);
    const Vec3 extent(scene.box.dim()[0], scene.box.dim()[1], scene.box.dim()[2]);
    scene.eye = low + extent * 0.5f + Vec3(0, 0, 2 * extent[2]);
    Timing timing{std::atoi(arguments[3]), std::atoi(arguments[4]), {}, {}};
    const std::vector<Pixel> picture = run(arguments[2], scene, timing);

    std::vector<float> values;
    double sum = 0, lookUps = 0;
    for (const Pixel& pixel : picture) {
        values.push_back(pixel.value);
        sum += pixel.value;
        lookUps += pixel.lookUps;
    }
    const double pixels = static_cast<double>(picture.size());
    std::printf("median_ms=%.3f min_ms=%.3f cpu_ms=%.3f mean=%.6f look_ups=%.1f\n", median(timing.times),
                *std::min_element(timing.times.begin(), timing.times.end()), median(timing.cpuTimes), sum / pixels,
                lookUps / pixels);
    if (count > 6) {
        std::ofstream file(arguments[6], std::ios::binary);
        file.write(reinterpret_cast<const char*>(values.data()), static_cast<std::streamsize>(values.size() * sizeof(float)));
        if (!file.flush()) throw std::runtime_error("the picture was not written");
    }
    return 0;
}

} // namespace

int main(int count, char** arguments)
{
    try {
        return main2(count, arguments);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "nanovdb_rays: %s\n", error.what());
        return 1;
    }
}
