/* The floor of the comparison: one fixed network (3-16-3, ReLU, mini-batches of 8, Adam) written by
 * hand for this machine. Sixteen seeds lie in the lanes of a vector. It shuffles, trains and sums
 * the loss; it has no validation, no history, no other shape. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { IN = 3, HIDDEN = 16, OUT = 3, BATCH = 8, LANES = 16 };
enum { W1 = 0, B1 = W1 + IN * HIDDEN, W2 = B1 + HIDDEN, B2 = W2 + HIDDEN * OUT, SIZE = B2 + OUT };

typedef float vec __attribute__((vector_size(4 * LANES)));
typedef int32_t mask __attribute__((vector_size(4 * LANES)));

static inline vec fill(float a) {
  vec r;
  for (int l = 0; l < LANES; l++) r[l] = a;
  return r;
}

/* b where a is positive, else zero. */
static inline vec where_positive(vec a, vec b) { return (vec)((mask)(a > 0) & (mask)b); }

static inline vec root(vec a) {
  vec r;
  for (int l = 0; l < LANES; l++) r[l] = __builtin_sqrtf(a[l]);
  return r;
}

static inline uint64_t mix(uint64_t x) {
  x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9u;
  x = (x ^ (x >> 27)) * 0x94D049BB133111EBu;
  return x ^ (x >> 31);
}

static void shuffle(int32_t *order, int n, uint64_t seed, uint64_t epoch) {
  const uint64_t golden = 0x9E3779B97F4A7C15u;
  uint64_t start = mix(mix(seed + golden) + epoch);
  for (int i = 0; i < n; i++) order[i] = i;
  for (int i = n - 1; i > 0; i--) {
    int j = (int)(((mix(start + i * golden) >> 32) * (uint64_t)(i + 1)) >> 32);
    int32_t t = order[i];
    order[i] = order[j];
    order[j] = t;
  }
}

static inline void adam(vec *w, vec *m, vec *v, int p, vec g, vec rate, vec epsilon) {
  m[p] = 0.9f * m[p] + 0.1f * g;
  v[p] = 0.999f * v[p] + 0.001f * (g * g);
  w[p] -= rate * m[p] / (root(v[p]) + epsilon);
}

/* One group of 16 seeds. rates and epsilons: Adam's step size and epsilon of every step, bias
 * corrections included. losses: sum of squared errors of the last epoch, per lane. */
void train(const float *x, const float *y, int n, int epochs, const uint64_t *seeds,
           const float *rates, const float *epsilons, vec *w, vec *m, vec *v, float *losses) {
  int32_t *order = malloc(sizeof(int32_t) * LANES * n);
  long step = 0;
  for (int epoch = 1; epoch <= epochs; epoch++) {
    for (int l = 0; l < LANES; l++) shuffle(order + (long)l * n, n, seeds[l], epoch);
    vec total = fill(0);
    for (int first = 0; first < n; first += BATCH, step++) {
      int count = n - first < BATCH ? n - first : BATCH;
      vec a[IN][BATCH], t[OUT][BATCH], h[HIDDEN][BATCH], d[OUT][BATCH];
      for (int s = 0; s < BATCH; s++) {
        int at = first + (s < count ? s : 0);
        for (int l = 0; l < LANES; l++) {
          int row = order[(long)l * n + at];
          for (int i = 0; i < IN; i++) a[i][s][l] = x[row * IN + i];
          for (int k = 0; k < OUT; k++) t[k][s][l] = y[row * OUT + k];
        }
      }
      for (int j = 0; j < HIDDEN; j++)
        for (int s = 0; s < BATCH; s++) {
          vec z = w[B1 + j];
          for (int i = 0; i < IN; i++) z += a[i][s] * w[W1 + i * HIDDEN + j];
          h[j][s] = where_positive(z, z);
        }
      vec scale = fill(2.0f / (count * OUT));
      for (int k = 0; k < OUT; k++) {
        vec z[BATCH];
        for (int s = 0; s < BATCH; s++) z[s] = w[B2 + k];
        for (int j = 0; j < HIDDEN; j++)
          for (int s = 0; s < BATCH; s++) z[s] += h[j][s] * w[W2 + j * OUT + k];
        for (int s = 0; s < BATCH; s++) {
          vec e = s < count ? z[s] - t[k][s] : fill(0);
          total += e * e;
          d[k][s] = e * scale;
        }
      }
      vec rate = fill(rates[step]), epsilon = fill(epsilons[step]);
      for (int j = 0; j < HIDDEN; j++) {
        vec back[BATCH];
        for (int s = 0; s < BATCH; s++) back[s] = fill(0);
        for (int k = 0; k < OUT; k++) {
          vec g = fill(0), weight = w[W2 + j * OUT + k];
          for (int s = 0; s < BATCH; s++) {
            g += h[j][s] * d[k][s];
            back[s] += d[k][s] * weight;
          }
          adam(w, m, v, W2 + j * OUT + k, g, rate, epsilon);
        }
        vec bias = fill(0), slope[IN] = {fill(0), fill(0), fill(0)};
        for (int s = 0; s < BATCH; s++) {
          vec b = where_positive(h[j][s], back[s]);
          bias += b;
          for (int i = 0; i < IN; i++) slope[i] += a[i][s] * b;
        }
        for (int i = 0; i < IN; i++) adam(w, m, v, W1 + i * HIDDEN + j, slope[i], rate, epsilon);
        adam(w, m, v, B1 + j, bias, rate, epsilon);
      }
      for (int k = 0; k < OUT; k++) {
        vec g = fill(0);
        for (int s = 0; s < BATCH; s++) g += d[k][s];
        adam(w, m, v, B2 + k, g, rate, epsilon);
      }
    }
    memcpy(losses, &total, sizeof total);
  }
  free(order);
}
