//! Device choice: hardware GPU, software Vulkan.
