#include <stdint.h>
typedef struct {
    float    noise;  // mean squared innovation
    uint32_t known_n;
} my_state_t;
