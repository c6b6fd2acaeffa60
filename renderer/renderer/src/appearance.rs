//! Direct appearance, colours without learned weights: FlyHuman section 3.2 (Eq. 5 to 12) with linear RGB as the feature.
//!
//! Four kernels, on the device without a round trip or on the processor (`processor.rs`):
//!
//! 1. **observe** (a thread a Gaussian, a dispatch a view): projects the point of the drawn surface above
//!    the centre (w of the normals) with the camera's own lens, samples the image
//!    in linear light and weighs it by viewing angle and visibility in canonical space. Texels count by their mask
//!    coverage, so the background never bleeds in, and the view's weight shrinks with the coverage left.
//! 2. **gather** (a thread a graph node): visibility-weighted mean of the Gaussians around the node.
//! 3. **diffuse** (one workgroup): screened Laplace equation over the surface graph, multi-level. Parts that no edge
//!    connects to a seen one get the mean colour seen, grey when nothing is seen at all.
//! 4. **paint** (a thread a Gaussian): inpainting, temporal memory and the blend of both.
//!
//! Sums run in a fixed order without atomics: the same input gives the same bytes on the same device.
//!
//! # Where the paper leaves room
//!
//! - **Eq. 9.** The angle weight of Eq. 7 is harsh: a point seen at 45 degrees has w = 0.29. The paper's f_gcn is
//!   made from the graph's feature *and* the point's own image feature, so it can keep the detail of such a point;
//!   a plainly diffused colour would blur 71% of it. Our f_gcn is the pointwise minimum of
//!   `w_vis |f - f_seen|^2 + inpaint_weight |f - f_diffused|^2`.
//! - **Eq. 11.** d(x) measures how good the current observation is. Taken as the distance alone it is small on a
//!   silhouette's edge too, where nothing useful was seen, and would drop the memory there for a filled-in colour.
//!   We lengthen the best view's d by `-ln(s) / k`, s being the share of the current colour that was really
//!   seen: 0 for a point seen well (the equation as printed), infinite for an unseen one (the memory rules).
//!   So `w = (w_acc / w_max) (1 - s exp(-k d))`. Best view: the smallest d among those with a positive weight.
//! - **Sharpness.** Every Gaussian is drawn over its neighbours, so that colours taken from an image draw a blurred one. What
//!   a view tells is raised by what drawing takes away: W + g (c - D c), with W the image, c the colours of the last frame
//!   and D c their drawing, both at the Gaussian. Repeated, that solves (1 - g + g D) c = W: for g towards 1 the drawing is
//!   the image, for less noise that drawing cannot show stays bounded. It costs no drawing of its own: the visibility needs
//!   one anyway.
//! - **No spatial aggregation**: the paper's baseline. A camera that has the point inside image and mask gets a
//!   small extra weight, visible or not; the weights are normalised. Points inside no image are grey.

pub(crate) mod color_means;
mod graph_buffers;
pub(crate) mod hierarchy;
mod kernels;
mod processor;
pub(crate) mod settings;
pub(crate) mod update;
