// From light to a picture: highlights roll off instead of clipping; the square root stands for the display's gamma, which costs
// a power function.
vec3 toned(vec3 light) {
  return sqrt(clamp(light * (1 + 0.12 * light) / (1 + 0.45 * light) * 1.22, 0, 1));
}
