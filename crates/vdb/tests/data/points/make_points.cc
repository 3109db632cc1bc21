// Makes the grids of points of this folder with OpenVDB (10.0) and writes what OpenVDB reads from them
// as JSON.
//   g++ -std=c++17 -O1 make_points.cc -lopenvdb -ltbb -lImath -o make_points && ./make_points FOLDER
#include <openvdb/openvdb.h>
#include <openvdb/points/PointConversion.h>
#include <openvdb/points/PointCount.h>
#include <openvdb/points/PointGroup.h>
#include <openvdb/tools/PointIndexGrid.h>
#include <fstream>
#include <iomanip>
using namespace openvdb;
using namespace openvdb::points;

static uint32_t state = 1;
static uint32_t random32() { return state = state * 1664525u + 1013904223u; }
static double unit() { return (random32() >> 8) / double(1 << 24); }

template <typename T> struct Fill {
    static T get(int) { return T(unit() * 200 - 100); }
};
template <> struct Fill<bool> { static bool get(int) { return unit() < 0.5; } };
template <typename T> struct Fill<math::Vec3<T>> {
    static math::Vec3<T> get(int i) { return {Fill<T>::get(i), Fill<T>::get(i), Fill<T>::get(i)}; }
};
template <typename T> struct Fill<math::Quat<T>> {
    static math::Quat<T> get(int i) {
        return {Fill<T>::get(i), Fill<T>::get(i), Fill<T>::get(i), Fill<T>::get(i)};
    }
};
template <typename T> struct Fill<math::Mat3<T>> {
    static math::Mat3<T> get(int i) { math::Mat3<T> m; for (int k = 0; k < 9; ++k)
        m.asPointer()[k] = Fill<T>::get(i); return m; }
};
template <typename T> struct Fill<math::Mat4<T>> {
    static math::Mat4<T> get(int i) { math::Mat4<T> m; for (int k = 0; k < 16; ++k)
        m.asPointer()[k] = Fill<T>::get(i); return m; }
};

enum Range { Any, Unit, Around, Direction };
template <typename T, typename Codec = NullCodec>
void add(PointDataTree& tree, const char* name, Range range = Any, int stride = 1) {
    appendAttribute<T, Codec>(tree, name, zeroVal<T>(), stride);
    int i = 0;
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        AttributeWriteHandle<T, Codec> handle(leaf->attributeArray(name));
        for (Index n = 0; n < handle.size(); ++n)
            for (int k = 0; k < stride; ++k) {
                T value = Fill<T>::get(i++);
                if constexpr (std::is_same_v<T, float> || std::is_same_v<T, Vec3f>) {
                    if (range == Unit) value = value / 200.0f + T(0.5f);
                    if (range == Around) value = value / 200.0f;
                }
                if constexpr (std::is_same_v<T, Vec3f>) { if (range == Direction) value.normalize(); }
                handle.set(n, k, value);
            }
    }
}

template <typename Codec>
PointDataGrid::Ptr grid(const char* name, int count, double size, double shift = 0) {
    std::vector<Vec3R> positions;
    for (int i = 0; i < count; ++i) positions.push_back({unit() * size, unit() * size - shift, unit()
        * size});
    auto transform = math::Transform::createLinearTransform(0.25);
    PointAttributeVector<Vec3R> wrapper(positions);
    auto index = tools::createPointIndexGrid<tools::PointIndexGrid>(wrapper, *transform);
    auto grid = createPointDataGrid<Codec, PointDataGrid>(*index, wrapper, *transform);
    grid->setName(name);
    return grid;
}

PointDataGrid::Ptr everything() {
    auto points = grid<NullCodec>("everything", 30, 2.5, 1.2);
    auto& tree = points->tree();
    add<float>(tree, "float");
    add<double>(tree, "double");
    add<int8_t>(tree, "int8");
    add<int16_t>(tree, "int16");
    add<int32_t>(tree, "int32");
    add<int64_t>(tree, "int64");
    add<bool>(tree, "bool");
    add<Vec3i>(tree, "vec3i");
    add<Vec3f>(tree, "vec3s");
    add<Vec3d>(tree, "vec3d");
    add<math::Quat<float>>(tree, "quats");
    add<math::Quat<double>>(tree, "quatd");
    add<Mat3s>(tree, "mat3s");
    add<Mat4d>(tree, "mat4d");
    add<float, TruncateCodec>(tree, "half");
    add<Vec3f, TruncateCodec>(tree, "half3");
    add<float, FixedPointCodec<true, UnitRange>>(tree, "unit8", Unit);
    add<float, FixedPointCodec<false, UnitRange>>(tree, "unit16", Unit);
    add<Vec3f, FixedPointCodec<true, PositionRange>>(tree, "around8", Around);
    add<Vec3f, FixedPointCodec<false, UnitRange>>(tree, "unit16_3", Unit);
    add<Vec3f, UnitVecCodec>(tree, "direction", Direction);
    add<int32_t>(tree, "strided", Any, 3);
    add<float>(tree, "passing");
    add<float>(tree, "hidden");
    appendAttribute<float>(tree, "same", 2.5f);
    appendAttribute<Vec3d>(tree, "same3", Vec3d(1, 2, 3));
    appendAttribute<int32_t>(tree, "varying", 7, 11, /*constantStride=*/false);
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        leaf->attributeArray("passing").setTransient(true);
        leaf->attributeArray("hidden").setHidden(true);
    }
    for (const char* name : {"odd", "first", "none"}) appendGroup(tree, name);
    for (int i = 0; i < 7; ++i) appendGroup(tree, "more" + std::to_string(i));
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        auto odd = leaf->groupWriteHandle("odd"), first = leaf->groupWriteHandle("first"),
             last = leaf->groupWriteHandle("more6");
        for (Index n = 0; n < leaf->pointCount(); ++n) { odd.set(n, n % 2); first.set(n, n == 0);
            last.set(n, n % 3 == 0); }
    }
    appendAttribute(tree, "text", StringAttributeArray::attributeType());
    auto descriptor = makeDescriptorUnique(tree);
    StringMetaInserter inserter(descriptor->getMetadata());
    const char* texts[] = {"", "water", "fire", "äther"};
    for (const char* text : texts) if (*text) inserter.insert(text);
    for (auto leaf = tree.beginLeaf(); leaf; ++leaf) {
        StringAttributeWriteHandle handle(leaf->attributeArray("text"), descriptor->getMetadata());
        for (Index n = 0; n < leaf->pointCount(); ++n) handle.set(n, std::string(texts[random32() >> 30]));
    }
    return points;
}

template <typename T> void number(std::ostream& out, const T& x) { out << +x; }
template <typename T> void numbers(std::ostream& out, const T* x, int n) {
    for (int i = 0; i < n; ++i) { if (i) out << ","; number(out, x[i]); }
}
template <typename T> void value(std::ostream& out, const T& x) { number(out, x); }
template <typename T> void value(std::ostream& out, const math::Vec3<T>& x) { numbers(out, x.asPointer(),
    3); }
template <typename T> void value(std::ostream& out, const math::Quat<T>& x) { const T n[4] = {x[0], x[1],
    x[2], x[3]}; numbers(out, n, 4); }
template <typename T> void value(std::ostream& out, const math::Mat3<T>& x) { numbers(out, x.asPointer(),
    9); }
template <typename T> void value(std::ostream& out, const math::Mat4<T>& x) { numbers(out, x.asPointer(),
    16); }

template <typename T> bool values(std::ostream& out, const AttributeArray& array) {
    if (array.valueType() != typeNameAsString<T>()) return false;
    AttributeHandle<T> handle(array);
    Index count = array.hasConstantStride() ? array.size() * array.stride() : array.dataSize();
    for (Index i = 0; i < count; ++i) {
        if (i) out << ",";
        if (array.hasConstantStride()) value(out, handle.get(i / array.stride(), i % array.stride()));
        else value(out, handle.get(0, i));
    }
    return true;
}

template <typename... T> void any_values(std::ostream& out, const AttributeArray& array) {
    if (!(values<T>(out, array) || ...)) throw std::runtime_error("type " + std::string(array.valueType()));
}

void dump(std::ostream& out, const PointDataGrid& grid) {
    out << "{\"name\":\"" << grid.getName() << "\",\"points\":" << pointCount(grid.tree()) << ",\"leaves\":[";
    bool first_leaf = true;
    for (auto leaf = grid.tree().cbeginLeaf(); leaf; ++leaf) {
        out << (first_leaf ? "\n" : ",\n") << "{\"origin\":[" << leaf->origin().x()
            << "," << leaf->origin().y() << ","
            << leaf->origin().z() << "],\"points\":" << leaf->pointCount();
        first_leaf = false;
        const auto& set = leaf->attributeSet();
        if (set.find("P") != AttributeSet::INVALID_POS) {
            AttributeHandle<Vec3f> handle(leaf->constAttributeArray("P"));
            out << ",\"positions\":[";
            bool first = true;
            for (auto i = leaf->beginIndexAll(); i; ++i) {
                Vec3d index = i.getCoord().asVec3d() + Vec3d(handle.get(*i));
                Vec3d world = grid.transform().indexToWorld(index);
                if (!first) out << ",";
                first = false;
                out << "[["; value(out, index); out << "],["; value(out, world); out << "]]";
            }
            out << "]";
        }
        std::vector<std::string> names(set.size());
        for (const auto& entry : set.descriptor().map()) names[entry.second] = entry.first;
        out << ",\"attributes\":[";
        for (size_t i = 0; i < set.size(); ++i) {
            const AttributeArray& array = *set.getConst(i);
            out << (i ? ",\n" : "") << "{\"name\":\"" << names[i] << "\",\"type\":\"" << array.valueType()
                << "\",\"codec\":\""
                << array.codecType() << "\",\"points\":" << array.size() << ",\"stride\":" << array.stride()
                << ",\"uniform\":" << array.isUniform() << ",\"hidden\":" << array.isHidden()
                    << ",\"values\":[";
            if (isString(array)) {
                StringAttributeHandle handle(array, set.descriptor().getMetadata());
                for (Index n = 0; n < array.size(); ++n) out << (n ? "," : "") << "\"" << handle.get(n)
                    << "\"";
            } else if (isGroup(array)) {
                GroupAttributeArray::ValueType v;
                for (Index n = 0; n < array.size(); ++n) {
                    v = GroupAttributeArray::cast(array).get(n);
                    out << (n ? "," : "") << +v;
                }
            } else {
                any_values<float, double, int8_t, int16_t, int32_t, int64_t, bool, Vec3i, Vec3f, Vec3d,
                    math::Quat<float>,
                    math::Quat<double>, Mat3s, Mat3d, Mat4s, Mat4d>(out, array);
            }
            out << "]}";
        }
        out << "],\"groups\":{";
        bool first = true;
        for (const auto& entry : set.descriptor().groupMap()) {
            auto handle = leaf->groupHandle(entry.first);
            out << (first ? "" : ",") << "\"" << entry.first << "\":[";
            first = false;
            for (Index n = 0, k = 0; n < leaf->pointCount(); ++n) if (handle.get(n))
                out << (k++ ? "," : "") << n;
            out << "]";
        }
        out << "}}";
    }
    out << "]}\n";
}

int main(int, char** args) {
    initialize();
    const std::string folder = std::string(args[1]) + "/";
    auto save = [&](const std::string& name, const GridCPtrVec& grids, uint32_t compression) {
        io::File file(folder + name + ".vdb");
        file.setCompression(compression);
        file.write(grids);
        file.close();
    };
    auto dump_file = [&](const std::string& name) {
        io::File file(folder + name + ".vdb");
        file.open(/*delayLoad=*/false);
        std::ofstream out(folder + name + ".json");
        out << std::setprecision(17) << "[";
        bool first = true;
        auto grids = file.getGrids();
        for (auto& grid : *grids)
            if (auto points = gridPtrCast<PointDataGrid>(grid)) { out << (first ? "" : ","); first = false;
                dump(out, *points); }
        out << "]\n";
    };
    auto other = FloatGrid::create(3.0f);
    other->setName("other");
    other->tree().setValue(Coord(1, 2, 3), 5.0f);

    GridCPtrVec grids{everything(), grid<FixedPointCodec<true>>("fixed8", 60, 4),
        grid<FixedPointCodec<false>>("fixed16", 60, 4), other};
    save("codings_blosc", grids, io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK);
    save("codings_zip", {grids[1], grids[2]}, io::COMPRESS_ZIP | io::COMPRESS_ACTIVE_MASK);
    save("codings_none", {grids[0], other}, io::COMPRESS_ACTIVE_MASK);
    dump_file("codings_blosc");

    // Leaves with sets of attributes of their own, and one without any.
    auto sets = grid<FixedPointCodec<false>>("sets", 50, 4);
    makeDescriptorUnique(sets->tree());
    int i = 0;
    for (auto leaf = sets->tree().beginLeaf(); leaf; ++leaf, ++i) {
        if (i % 3 == 0) continue;
        auto descriptor = std::make_shared<AttributeSet::Descriptor>(leaf->attributeSet().descriptor());
        leaf->resetDescriptor(descriptor);
        std::string name = i % 3 == 1 ? "id" : "weight";
        auto type = i % 3 == 1 ? TypedAttributeArray<int32_t>::attributeType()
            : TypedAttributeArray<double>::attributeType();
        auto wider = descriptor->duplicateAppend(name, type);
        leaf->appendAttribute(*descriptor, wider, wider->find(name));
        auto& array = leaf->attributeArray(name);
        for (Index n = 0; n < array.size(); ++n) {
            if (i % 3 == 1) AttributeWriteHandle<int32_t>(array).set(n, 100 * i + n);
            else AttributeWriteHandle<double>(array).set(n, 0.1 * n + i);
        }
    }
    sets->tree().touchLeaf(Coord(200, 0, 0))->setValuesOn();
    save("sets", {sets, other}, io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK);
    dump_file("sets");

    // Leaves whose arrays fill a page, and others that share one. The values follow from the order of the
    // points.
    std::vector<Vec3R> positions;
    for (int n = 0; n < 160000; ++n) {
        const int leaf = n < 60000 ? 0 : n / 20000 - 2;
        positions.push_back(Vec3R(leaf * 8, n / 2048 % 16 / 4, n / 4096 % 8));
    }
    PointAttributeVector<Vec3R> wrapper(positions);
    auto transform = math::Transform::createLinearTransform(1.0);
    auto index = tools::createPointIndexGrid<tools::PointIndexGrid>(wrapper, *transform);
    auto pages = createPointDataGrid<FixedPointCodec<true>, PointDataGrid>(*index, wrapper, *transform);
    pages->setName("pages");
    appendAttribute<int32_t>(pages->tree(), "number");
    appendAttribute<Vec3d>(pages->tree(), "triple");
    for (auto leaf = pages->tree().beginLeaf(); leaf; ++leaf) {
        AttributeWriteHandle<int32_t> number(leaf->attributeArray("number"));
        AttributeWriteHandle<Vec3d> triple(leaf->attributeArray("triple"));
        const int x = leaf->origin().x();
        for (Index n = 0; n < leaf->pointCount(); ++n) { number.set(n, x + n / 1000); triple.set(n,
            Vec3d(x, n / 4096, 0.5)); }
    }
    save("pages", {pages, other}, io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK);

    // Indices of points, which are passed over.
    std::vector<Vec3R> some;
    for (int n = 0; n < 30; ++n) some.push_back({unit() * 20, unit() * 20, unit() * 20});
    PointAttributeVector<Vec3R> some_wrapper(some);
    auto indices = tools::createPointIndexGrid<tools::PointIndexGrid>(some_wrapper, *transform);
    indices->setName("indices");
    if (!tools::PointIndexGrid::isRegistered()) tools::PointIndexGrid::registerGrid();
    save("indices", {indices, other}, io::COMPRESS_BLOSC | io::COMPRESS_ACTIVE_MASK);
}
