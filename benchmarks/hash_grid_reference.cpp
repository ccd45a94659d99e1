// What a user with a compiler could have: the hash grid and its sparse Adam as fused C++ loops.
// Only benchmarks/bench_hash_grid.py builds it (g++ -O3 -march=native -ffast-math -fopenmp), to
// compare the compiled loops of the package with. Two features per entry, fp32.
#include <cmath>
#include <cstdint>

namespace {

constexpr uint32_t PRIME_Y = 2654435761u, PRIME_Z = 805459861u;
constexpr int TILE = 256;
constexpr int BLOCK = 8;  // entries of two features in one cache line
constexpr int AHEAD = 8;  // points whose entries are fetched before their turn

struct Corners {
    alignas(64) uint32_t entry[8][TILE];
    alignas(64) float weight[8][TILE];
};

// Cells and weights of a tile of points; vectorised by the compiler.
inline void locate(Corners& c, const float* points, const uint32_t* salt, int count, float scale,
                   uint32_t mask) {
    for (int p = 0; p < count; ++p) {
        const float x = points[3 * p] * scale, y = points[3 * p + 1] * scale,
                    z = points[3 * p + 2] * scale;
        const float fx = std::floor(x), fy = std::floor(y), fz = std::floor(z);
        const uint32_t x0 = uint32_t(int32_t(fx)), x1 = x0 + 1;
        const uint32_t y0 = uint32_t(int32_t(fy)) * PRIME_Y, y1 = y0 + PRIME_Y;
        const uint32_t low_z = uint32_t(int32_t(fz)) * PRIME_Z;
        const uint32_t z0 = low_z ^ salt[p], z1 = (low_z + PRIME_Z) ^ salt[p];
        const float u = x - fx, v = y - fy, w = z - fz;
        const float a = 1 - u, b = 1 - v, d = 1 - w;
        c.entry[0][p] = (x0 ^ y0 ^ z0) & mask, c.weight[0][p] = a * b * d;
        c.entry[1][p] = (x1 ^ y0 ^ z0) & mask, c.weight[1][p] = u * b * d;
        c.entry[2][p] = (x0 ^ y1 ^ z0) & mask, c.weight[2][p] = a * v * d;
        c.entry[3][p] = (x1 ^ y1 ^ z0) & mask, c.weight[3][p] = u * v * d;
        c.entry[4][p] = (x0 ^ y0 ^ z1) & mask, c.weight[4][p] = a * b * w;
        c.entry[5][p] = (x1 ^ y0 ^ z1) & mask, c.weight[5][p] = u * b * w;
        c.entry[6][p] = (x0 ^ y1 ^ z1) & mask, c.weight[6][p] = a * v * w;
        c.entry[7][p] = (x1 ^ y1 ^ z1) & mask, c.weight[7][p] = u * v * w;
    }
}

}  // namespace

extern "C" void look_up(const float* points, const uint32_t* salt, const float* table,
                        const float* scales, int64_t n, int levels, int log2_entries, float* out) {
    const int64_t size = int64_t(1) << log2_entries;
#pragma omp parallel
    {
        Corners c;
#pragma omp for schedule(dynamic, 8)
        for (int64_t start = 0; start < n; start += TILE) {
            const int count = int(n - start < TILE ? n - start : TILE);
            for (int level = 0; level < levels; ++level) {
                locate(c, points + 3 * start, salt + start, count, scales[level], size - 1);
                const float* grid = table + 2 * level * size;
                for (int p = 0; p < count; ++p) {
                    const int next = p + AHEAD < count ? p + AHEAD : count - 1;
                    for (int corner = 0; corner < 8; ++corner)
                        __builtin_prefetch(grid + 2 * c.entry[corner][next]);
                    float total0 = 0, total1 = 0;
                    for (int corner = 0; corner < 8; ++corner) {
                        const float* value = grid + 2 * c.entry[corner][p];
                        total0 += c.weight[corner][p] * value[0];
                        total1 += c.weight[corner][p] * value[1];
                    }
                    out[(start + p) * 2 * levels + 2 * level] = total0;
                    out[(start + p) * 2 * levels + 2 * level + 1] = total1;
                }
            }
        }
    }
}

// One level belongs to one thread: no atomics, the same sum every time.
extern "C" void scatter(const float* points, const uint32_t* salt, const float* scales, int64_t n,
                        int levels, int log2_entries, const float* upstream, float* gradient,
                        uint8_t* is_touched) {
    const int64_t size = int64_t(1) << log2_entries;
#pragma omp parallel for schedule(dynamic, 1)
    for (int reverse = 0; reverse < levels; ++reverse) {
        const int level = levels - 1 - reverse;  // the slowest first
        Corners c;
        float* grid = gradient + 2 * level * size;
        uint8_t* marks = is_touched + level * size / BLOCK;
        for (int64_t start = 0; start < n; start += TILE) {
            const int count = int(n - start < TILE ? n - start : TILE);
            locate(c, points + 3 * start, salt + start, count, scales[level], size - 1);
            for (int p = 0; p < count; ++p) {
                const int next = p + AHEAD < count ? p + AHEAD : count - 1;
                for (int corner = 0; corner < 8; ++corner)
                    __builtin_prefetch(grid + 2 * c.entry[corner][next], 1);
                const float* share = upstream + (start + p) * 2 * levels + 2 * level;
                const float share0 = share[0], share1 = share[1];
                for (int corner = 0; corner < 8; ++corner) {
                    const uint32_t i = c.entry[corner][p];
                    marks[i / BLOCK] = 1;
                    grid[2 * i] += c.weight[corner][p] * share0;
                    grid[2 * i + 1] += c.weight[corner][p] * share1;
                }
            }
        }
    }
}

extern "C" void update_touched(float* values, float* gradient, float* mean, float* square,
                               uint8_t* is_touched, int64_t blocks, float beta1, float beta2,
                               float step_size, float correction, float epsilon) {
    constexpr int WIDTH = 2 * BLOCK;
#pragma omp parallel for schedule(dynamic, 4096)
    for (int64_t block = 0; block < blocks; ++block) {
        if (!is_touched[block]) continue;
        is_touched[block] = 0;
        float *x = values + WIDTH * block, *g = gradient + WIDTH * block,
              *m = mean + WIDTH * block, *v = square + WIDTH * block;
#pragma omp simd
        for (int i = 0; i < WIDTH; ++i) {
            const float slope = g[i];
            const bool is_used = slope != 0;
            const float new_m = beta1 * m[i] + (1 - beta1) * slope;
            const float new_v = beta2 * v[i] + (1 - beta2) * slope * slope;
            const float change = step_size * new_m / (std::sqrt(new_v) * correction + epsilon);
            m[i] = is_used ? new_m : m[i];
            v[i] = is_used ? new_v : v[i];
            x[i] -= is_used ? change : 0;
            g[i] = 0;
        }
    }
}
