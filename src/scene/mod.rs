//! What is in the beam: scene files, volumes, shapes, the robot, materials, the beam and the detector.

pub mod physics;

pub mod model;
