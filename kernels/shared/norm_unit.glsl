// The unit in which a row is normed: squares of values beyond 1.8e19 would overflow.

// By the largest magnitude of the row; a power of two, which rounds nothing.
float norm_unit(float largest) { return largest > 1e18 ? 5.421010862427522e-20 : 1.0; }

// Epsilon beside squares in that unit. It is nothing beside those of such a row, but keeps a constant one from 0 / 0.
float norm_epsilon(float eps, float unit) { return unit < 1.0 ? 1e-37 : eps; }
