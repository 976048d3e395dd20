#version 450
// Derived from the shader pack "minimal" of SAPIEN 3 (Copyright 2025 Hillbot Inc., 2020-2024 UCSD SU Lab; Apache License 2.0,
// see NOTICE); changed for manifeel_ms3.
layout(set = 0, binding = 0) uniform LightBuffer {
  mat4 viewMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrix;
  mat4 projectionMatrixInverse;
  int width;
  int height;
} lightBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in vec3 tangent;
layout(location = 4) in vec3 bitangent;

void main() {
  // matrix times vector three times, not matrix times matrix
  vec4 world = objectTransformBuffer.modelMatrix * vec4(position, 1);
  gl_Position = lightBuffer.projectionMatrix * (lightBuffer.viewMatrix * world);
}
