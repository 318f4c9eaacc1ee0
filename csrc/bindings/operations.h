// The operations that the modules of both devices have, for each type of number.
#pragma once

#include "bindings/reader.h"

// Functions of bt and of bt::cuda, templates of the type of number.
// clang-format off
#define BT_OPERATIONS(each)   \
  each(project_forward)       \
  each(project_backward)      \
  each(trace_backward)        \
  each(composite_forward)     \
  each(composite_backward)    \
  each(blend_forward)         \
  each(blend_backward)        \
  each(view_color_forward)    \
  each(view_color_backward)   \
  each(lean_color)            \
  each(field_forward)         \
  each(field_backward)        \
  each(shade_forward)         \
  each(shade_backward)        \
  each(ssim)
// clang-format on
