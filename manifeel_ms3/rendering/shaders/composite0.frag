#version 450
// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
// The finished picture: the room behind the scene, and smooth edges by a blur along them (fast approximate anti-aliasing).
layout (constant_id = 0) const int NUM_DIRECTIONAL_LIGHTS = 3;
layout (constant_id = 1) const int NUM_POINT_LIGHTS = 3;
layout (constant_id = 2) const int NUM_DIRECTIONAL_LIGHT_SHADOWS = 1;
layout (constant_id = 3) const int NUM_POINT_LIGHT_SHADOWS = 1;
layout (constant_id = 4) const int NUM_TEXTURED_LIGHT_SHADOWS = 1;
layout (constant_id = 5) const int NUM_SPOT_LIGHT_SHADOWS = 1;
layout (constant_id = 6) const int NUM_SPOT_LIGHTS = 1;

layout(set = 0, binding = 0) uniform sampler2D samplerColorRaw;
layout(set = 0, binding = 1) uniform sampler2D samplerGbufferDepth;

layout(set = 1, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

#define SET_NUM 2
#include "scene_set.glsl"
#include "room.glsl"
#include "tone.glsl"

layout(location = 0) in vec2 inUV;

layout(location = 0) out vec4 outColor;

const float EDGE = 0.06;         // smallest step of brightness that counts as an edge, by eye
const float RELATIVE_EDGE = 0.12; // the same as a share of the brightest neighbour
const float SPAN = 4.0;          // pixels along an edge over which it is blurred at most

// Brightness of a pixel, which is black where nothing is drawn, before a wall of a brightness.
float brightness(vec4 color, float wall) {
  return dot(color.rgb, vec3(0.3, 0.6, 0.1)) + (1 - color.a) * wall;
}

void main() {
  vec2 pixel = 1 / vec2(cameraBuffer.width, cameraBuffer.height);
  vec4 color = texture(samplerColorRaw, inUV);
  // four blends of two by two pixels around this one
  float wall = toned(0.9 * WALL * sceneBuffer.ambientLight.rgb).g;
  float m = brightness(color, wall);
  float nw = brightness(texture(samplerColorRaw, inUV + pixel * vec2(-0.5, -0.5)), wall);
  float ne = brightness(texture(samplerColorRaw, inUV + pixel * vec2(0.5, -0.5)), wall);
  float sw = brightness(texture(samplerColorRaw, inUV + pixel * vec2(-0.5, 0.5)), wall);
  float se = brightness(texture(samplerColorRaw, inUV + pixel * vec2(0.5, 0.5)), wall);
  float low = min(m, min(min(nw, ne), min(sw, se))), high = max(m, max(max(nw, ne), max(sw, se)));
  if (high - low > max(EDGE, RELATIVE_EDGE * high)) {
    vec2 along = vec2(sw + se - nw - ne, nw + sw - ne - se); // the gradient, turned by a right angle
    vec2 steps = clamp(along / (min(abs(along.x), abs(along.y)) + 0.03 * high + 1e-4), -SPAN, SPAN) * pixel;
    vec4 near = 0.5 * (texture(samplerColorRaw, inUV - steps / 6) + texture(samplerColorRaw, inUV + steps / 6));
    vec4 far = 0.5 * near + 0.25 * (texture(samplerColorRaw, inUV - steps / 2) + texture(samplerColorRaw, inUV + steps / 2));
    float between = brightness(far, wall);
    color = between < low || between > high ? near : far; // the far ones may lie beyond the edge
  }
  if (color.a < 1) {
    vec4 ahead = cameraBuffer.projectionMatrixInverse * vec4(inUV * 2 - 1, 1, 1);
    vec3 direction = mat3(cameraBuffer.viewMatrixInverse) * (ahead.xyz / ahead.w);
    vec3 behind = background(cameraBuffer.viewMatrixInverse[3].xyz, direction) * sceneBuffer.ambientLight.rgb;
    color.rgb += (1 - color.a) * toned(behind); // nothing is black, and so is its share of a blend
  }
  outColor = color;
}
