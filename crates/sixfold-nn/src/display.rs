//! The text of a network for `Display`, which Burn asks of every module.

/// Displays modules by their names.
///
/// Burn's own text lists every layer, and its code for that is a sixth of what a crate with networks compiles; Sixfold prints no
/// network (docs/build.md). Each module also needs the attribute `#[module(custom_display)]`.
///
/// ```
/// use burn::{
///     module::Module,
///     nn::{Linear, LinearConfig},
///     tensor::Device,
/// };
///
/// #[derive(Module, Debug)]
/// #[module(custom_display)]
/// struct Small {
///     linear: Linear,
/// }
///
/// sixfold_nn::displayed_by_name!(Small);
///
/// let small = Small { linear: LinearConfig::new(2, 3).init(&Device::default()) };
/// assert_eq!(small.to_string(), "Small");
/// ```
#[macro_export]
macro_rules! displayed_by_name {
    ($($module:ident),+ $(,)?) => {$(
        impl ::burn::module::ModuleDisplay for $module {
            fn format(&self, _: ::burn::module::DisplaySettings) -> ::std::string::String {
                ::std::string::String::from(stringify!($module))
            }
        }
    )+};
}
