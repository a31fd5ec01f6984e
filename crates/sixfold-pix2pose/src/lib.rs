//! Pix2Pose (Park, Patten, Vincze 2019; dissertation chapter 3).

pub mod networks;
pub mod samples;
