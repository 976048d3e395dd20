// The room around the bench: what metal reflects, and what is seen behind the scene. Colours are linear, by eye; both are to be
// multiplied by the ambient light.
const vec3 CEILING = vec3(1.60, 1.62, 1.65);
const vec3 WALL = vec3(1.38, 1.41, 1.44);
const vec3 BENCH = vec3(0.95, 0.80, 0.62);
const vec3 SKIRTING = vec3(0.42, 0.44, 0.47);
const float HALF_WIDTH = 4.0;     // m; the walls stand on the edges of the floor
const float FLOOR_HEIGHT = -0.75; // m
const float SKIRTING_HEIGHT = 0.10; // m

// Light from a direction, blurred by the roughness of what reflects it.
vec3 reflected(vec3 direction, float roughness) {
  float blur = 0.06 + 0.9 * roughness;
  vec3 upper = mix(WALL, CEILING, smoothstep(0.45 - blur, 0.45 + blur, direction.z));
  // a long lamp over the bench, along x
  float lamp = smoothstep(0.80 - 0.5 * blur, 0.80 + 0.5 * blur, direction.z) * (1 - smoothstep(0.1, 0.3 + blur, abs(direction.y)));
  upper += vec3(2.2 * (1 - roughness)) * lamp;
  return mix(BENCH, upper, smoothstep(-0.05 - blur, 0.05 + blur, direction.z));
}

// Wall that a ray from a point inside the room meets.
vec3 background(vec3 eye, vec3 direction) {
  vec2 distances = (sign(direction.xy) * HALF_WIDTH - eye.xy) / (abs(direction.xy) + 1e-6) * sign(direction.xy);
  bool ahead = distances.x < distances.y; // the wall across x
  vec3 hit = eye + direction * (ahead ? distances.x : distances.y);
  float along = ahead ? hit.y : hit.x;
  float height = hit.z - FLOOR_HEIGHT;
  vec3 colour = WALL * (ahead ? 1.0 : 0.93) * (0.80 + 0.20 * smoothstep(0.0, 2.5, height));
  colour *= 0.88 + 0.12 * smoothstep(0.0, 1.2, HALF_WIDTH - abs(along)); // dusk in the corners
  colour = mix(colour, SKIRTING, 1 - step(SKIRTING_HEIGHT, height));
  return colour;
}
