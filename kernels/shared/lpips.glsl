// Input normalization of LPIPS 0.1 (Zhang et al. 2018), for values in -1..1.
const vec3 SHIFT = vec3(-0.030, -0.088, -0.188);
const vec3 SCALE = vec3(0.458, 0.448, 0.450);
