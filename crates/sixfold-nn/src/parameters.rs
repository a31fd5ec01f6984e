//! A network's parameters without the network's type.
//!
//! Burn compiles code that visits or changes parameters (an optimiser, a record, a weight file) once for each type of network, and
//! there once for each number of dimensions and each kind of number: 27 times. Here it is compiled once for all networks, in this
//! crate; a crate with its own network compiles only the conversion to and from this form. It makes the build 5 % shorter
//! (docs/build.md).

use std::any::Any;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Bool, Device, Gradients, Int, Tensor};

/// The numbers of a tensor.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Kind {
    Float,
    Int,
    Bool,
}

/// Expands `body` with the constant `D` for the number of dimensions; Burn has tensors of up to 8.
macro_rules! with_rank {
    ($rank:expr, $d:ident => $body:expr) => {
        with_rank!(@ $rank, $d, $body, 0, 1, 2, 3, 4, 5, 6, 7, 8)
    };
    (@ $rank:expr, $d:ident, $body:expr, $($number:literal),*) => {
        match $rank {
            $($number => { const $d: usize = $number; $body })*
            other => unreachable!("a tensor of {other} dimensions"),
        }
    };
}

/// A [`ModuleVisitor`] whose methods have no type parameters. `parameter` is the `Param<Tensor<D, K>>` given by `kind` and `rank`.
pub(crate) trait AnyVisitor {
    fn enter(&mut self, name: &str, container: &str);
    fn exit(&mut self, name: &str, container: &str);
    fn visit(&mut self, kind: Kind, rank: usize, parameter: &dyn Any);
}

impl<V: ModuleVisitor> AnyVisitor for V {
    fn enter(&mut self, name: &str, container: &str) {
        self.enter_module(name, container);
    }

    fn exit(&mut self, name: &str, container: &str) {
        self.exit_module(name, container);
    }

    fn visit(&mut self, kind: Kind, rank: usize, parameter: &dyn Any) {
        with_rank!(rank, D => match kind {
            Kind::Float => self.visit_float::<D>(typed(parameter)),
            Kind::Int => self.visit_int::<D>(typed(parameter)),
            Kind::Bool => self.visit_bool::<D>(typed(parameter)),
        });
    }
}

fn typed<T: Any>(parameter: &dyn Any) -> &T {
    parameter
        .downcast_ref()
        .unwrap_or_else(|| unreachable!("a parameter of the kind and rank that go with it"))
}

/// A [`ModuleMapper`] whose methods have no type parameters; it returns a parameter of the same type.
pub(crate) trait AnyMapper {
    fn enter(&mut self, name: &str, container: &str);
    fn exit(&mut self, name: &str, container: &str);
    fn map(&mut self, kind: Kind, rank: usize, parameter: Box<dyn Any>) -> Box<dyn Any>;
}

impl<M: ModuleMapper> AnyMapper for M {
    fn enter(&mut self, name: &str, container: &str) {
        self.enter_module(name, container);
    }

    fn exit(&mut self, name: &str, container: &str) {
        self.exit_module(name, container);
    }

    fn map(&mut self, kind: Kind, rank: usize, parameter: Box<dyn Any>) -> Box<dyn Any> {
        with_rank!(rank, D => match kind {
            Kind::Float => Box::new(self.map_float::<D>(owned(parameter))),
            Kind::Int => Box::new(self.map_int::<D>(owned(parameter))),
            Kind::Bool => Box::new(self.map_bool::<D>(owned(parameter))),
        })
    }
}

fn owned<T: Any>(parameter: Box<dyn Any>) -> T {
    let parameter = parameter.downcast();
    *parameter.unwrap_or_else(|_| unreachable!("a parameter of the kind and rank that go with it"))
}

/// A module whose parameters can be visited. Only this and [`Changeable`] are compiled for each network in its crate.
pub(crate) trait Visitable {
    fn show(&self, visitor: &mut dyn AnyVisitor);
}

impl<N: Module> Visitable for N {
    fn show(&self, visitor: &mut dyn AnyVisitor) {
        self.visit(&mut WithoutTypes(visitor));
    }
}

/// A module whose parameters can be changed.
pub(crate) trait Changeable {
    fn shown(&self) -> &dyn Visitable;
    fn change(&mut self, mapper: &mut dyn AnyMapper);
}

/// A module that is [`Changeable`].
pub(crate) struct Network<N>(Option<N>);

impl<N> Network<N> {
    pub(crate) fn new(module: N) -> Self {
        Network(Some(module))
    }

    pub(crate) fn into_inner(self) -> N {
        self.0.unwrap_or_else(|| unreachable!("{AWAY}"))
    }
}

/// Burn's `map` takes the module by value and returns it.
const AWAY: &str = "a module is away only while it is changed";

impl<N: Module> Changeable for Network<N> {
    fn shown(&self) -> &dyn Visitable {
        self.0.as_ref().unwrap_or_else(|| unreachable!("{AWAY}"))
    }

    fn change(&mut self, mapper: &mut dyn AnyMapper) {
        self.0 = self.0.take().map(|module| module.map(&mut WithoutTypes(mapper)));
    }
}

/// Burn's visitor or mapper that forwards to one without type parameters.
struct WithoutTypes<'a, T: ?Sized>(&'a mut T);

impl ModuleVisitor for WithoutTypes<'_, dyn AnyVisitor + '_> {
    fn enter_module(&mut self, name: &str, container: &str) {
        self.0.enter(name, container);
    }

    fn exit_module(&mut self, name: &str, container: &str) {
        self.0.exit(name, container);
    }

    fn visit_float<const D: usize>(&mut self, parameter: &Param<Tensor<D>>) {
        self.0.visit(Kind::Float, D, parameter);
    }

    fn visit_int<const D: usize>(&mut self, parameter: &Param<Tensor<D, Int>>) {
        self.0.visit(Kind::Int, D, parameter);
    }

    fn visit_bool<const D: usize>(&mut self, parameter: &Param<Tensor<D, Bool>>) {
        self.0.visit(Kind::Bool, D, parameter);
    }
}

impl ModuleMapper for WithoutTypes<'_, dyn AnyMapper + '_> {
    fn enter_module(&mut self, name: &str, container: &str) {
        self.0.enter(name, container);
    }

    fn exit_module(&mut self, name: &str, container: &str) {
        self.0.exit(name, container);
    }

    fn map_float<const D: usize>(&mut self, parameter: Param<Tensor<D>>) -> Param<Tensor<D>> {
        owned(self.0.map(Kind::Float, D, Box::new(parameter)))
    }

    fn map_int<const D: usize>(&mut self, parameter: Param<Tensor<D, Int>>) -> Param<Tensor<D, Int>> {
        owned(self.0.map(Kind::Int, D, Box::new(parameter)))
    }

    fn map_bool<const D: usize>(&mut self, parameter: Param<Tensor<D, Bool>>) -> Param<Tensor<D, Bool>> {
        owned(self.0.map(Kind::Bool, D, Box::new(parameter)))
    }
}

/// All parameters of a network in their order, as a separate module, for functions that Burn offers only for modules. They share
/// the network's tensors, ids and names.
#[derive(Debug, Clone)]
pub(crate) struct Parameters(Vec<Parameter>);

#[derive(Debug, Clone)]
struct Parameter {
    /// Name and kind of container of each module above it, and of itself.
    path: Vec<[String; 2]>,
    kind: Kind,
    rank: usize,
    value: Box<dyn Value>,
}

/// A `Param<Tensor<D, K>>`.
trait Value: Any + Send + std::fmt::Debug {
    fn duplicate(&self) -> Box<dyn Value>;
    fn add_devices(&self, devices: Vec<Device>) -> Vec<Device>;
    fn changed(self: Box<Self>, change: Change<'_>) -> Box<dyn Value>;
}

/// Operations on the parameters of a module.
#[derive(Clone, Copy)]
enum Change<'a> {
    Fork(&'a Device),
    ToDevice(&'a Device),
    Train,
    Valid,
    Materialize,
}

impl<T: Module + 'static> Value for T {
    fn duplicate(&self) -> Box<dyn Value> {
        Box::new(self.clone())
    }

    fn add_devices(&self, devices: Vec<Device>) -> Vec<Device> {
        self.collect_devices(devices)
    }

    fn changed(self: Box<Self>, change: Change<'_>) -> Box<dyn Value> {
        Box::new(match change {
            Change::Fork(device) => self.fork(device),
            Change::ToDevice(device) => self.to_device(device),
            Change::Train => self.train(),
            Change::Valid => self.valid(),
            Change::Materialize => self.materialize(),
        })
    }
}

impl Clone for Box<dyn Value> {
    fn clone(&self) -> Self {
        self.as_ref().duplicate()
    }
}

impl Parameters {
    pub(crate) fn of(module: &dyn Visitable) -> Self {
        let mut gathered = Gathered { path: Vec::new(), parameters: Vec::new() };
        module.show(&mut gathered);
        Parameters(gathered.parameters)
    }

    /// Puts the parameters back into their module.
    pub(crate) fn put_into(self, module: &mut dyn Changeable) {
        module.change(&mut Replaced(self.0.into_iter()));
    }

    fn change(self, change: Change<'_>) -> Self {
        let changed = |p: Parameter| Parameter { value: p.value.changed(change), ..p };
        Parameters(self.0.into_iter().map(changed).collect())
    }
}

struct Gathered {
    path: Vec<[String; 2]>,
    parameters: Vec<Parameter>,
}

impl AnyVisitor for Gathered {
    fn enter(&mut self, name: &str, container: &str) {
        self.path.push([name.to_owned(), container.to_owned()]);
    }

    fn exit(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit(&mut self, kind: Kind, rank: usize, parameter: &dyn Any) {
        let value: Box<dyn Value> = with_rank!(rank, D => match kind {
            Kind::Float => Box::new(typed::<Param<Tensor<D>>>(parameter).clone()),
            Kind::Int => Box::new(typed::<Param<Tensor<D, Int>>>(parameter).clone()),
            Kind::Bool => Box::new(typed::<Param<Tensor<D, Bool>>>(parameter).clone()),
        });
        self.parameters.push(Parameter { path: self.path.clone(), kind, rank, value });
    }
}

struct Replaced(std::vec::IntoIter<Parameter>);

impl AnyMapper for Replaced {
    fn enter(&mut self, _name: &str, _container: &str) {}

    fn exit(&mut self, _name: &str, _container: &str) {}

    fn map(&mut self, _kind: Kind, _rank: usize, _old: Box<dyn Any>) -> Box<dyn Any> {
        let new = self.0.next();
        new.unwrap_or_else(|| unreachable!("parameters go back into the network that they come from")).value
    }
}

impl Module for Parameters {
    fn collect_devices(&self, devices: Vec<Device>) -> Vec<Device> {
        self.0.iter().fold(devices, |devices, p| p.value.add_devices(devices))
    }

    fn fork(self, device: &Device) -> Self {
        self.change(Change::Fork(device))
    }

    fn to_device(self, device: &Device) -> Self {
        self.change(Change::ToDevice(device))
    }

    fn train(self) -> Self {
        self.change(Change::Train)
    }

    fn valid(&self) -> Self {
        self.clone().change(Change::Valid)
    }

    fn materialize(self) -> Self {
        self.change(Change::Materialize)
    }

    fn visit<V: ModuleVisitor>(&self, visitor: &mut V) {
        for Parameter { path, kind, rank, value } in &self.0 {
            path.iter().for_each(|[name, container]| visitor.enter_module(name, container));
            AnyVisitor::visit(visitor, *kind, *rank, value.as_ref());
            path.iter().rev().for_each(|[name, container]| visitor.exit_module(name, container));
        }
    }

    fn map<M: ModuleMapper>(self, mapper: &mut M) -> Self {
        let mapped = |Parameter { path, kind, rank, value }: Parameter| {
            path.iter().for_each(|[name, container]| mapper.enter_module(name, container));
            let value = with_rank!(rank, D => match kind {
                Kind::Float => Box::new(mapper.map_float::<D>(owned(value))) as Box<dyn Value>,
                Kind::Int => Box::new(mapper.map_int::<D>(owned(value))),
                Kind::Bool => Box::new(mapper.map_bool::<D>(owned(value))),
            });
            path.iter().rev().for_each(|[name, container]| mapper.exit_module(name, container));
            Parameter { path, kind, rank, value }
        };
        Parameters(self.0.into_iter().map(mapped).collect())
    }
}

/// Removes the gradients of a module's parameters from `gradients` and returns them.
pub fn gradients_of<M: Module>(gradients: &mut Gradients, module: &M) -> GradientsParams {
    taken_out(gradients, module)
}

fn taken_out(gradients: &mut Gradients, module: &dyn Visitable) -> GradientsParams {
    GradientsParams::from_module(gradients, &Parameters::of(module))
}

/// A sum of gradients of one module.
#[derive(Default)]
pub struct GradientSum(GradientsAccumulator<Parameters>);

impl GradientSum {
    /// An empty sum.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds gradients of `module`'s parameters.
    pub fn add<M: Module>(&mut self, module: &M, gradients: GradientsParams) {
        self.add_of(module, gradients);
    }

    fn add_of(&mut self, module: &dyn Visitable, gradients: GradientsParams) {
        self.0.accumulate(&Parameters::of(module), gradients);
    }

    /// The sum.
    pub fn into_gradients(mut self) -> GradientsParams {
        self.0.grads()
    }
}

#[cfg(test)]
mod tests {
    use burn::nn::conv::{Conv2d, Conv2dConfig};
    use burn::nn::{Linear, LinearConfig};
    use burn::optim::AdamWConfig;
    use burn::tensor::Distribution;

    use super::*;
    use crate::batch_norm::{BatchNorm, BatchNormConfig};
    use crate::learner::Learner;
    use crate::options::TrainingOptions;

    /// Parameters of one to four dimensions, running statistics, integers and booleans.
    #[derive(Module, Debug)]
    struct Net {
        conv: Conv2d,
        norm: BatchNorm,
        heads: Vec<Linear>,
        depth: Param<Tensor<3>>,
        counts: Param<Tensor<1, Int>>,
        mask: Param<Tensor<2, Bool>>,
    }

    fn net(device: &Device) -> Net {
        device.seed(3);
        Net {
            conv: Conv2dConfig::new([3, 4], [3, 3]).init(device),
            norm: BatchNormConfig::new(4).init(device),
            heads: vec![LinearConfig::new(4, 2).init(device), LinearConfig::new(4, 5).init(device)],
            depth: Param::from_tensor(Tensor::random([1, 4, 1], Distribution::Default, device)),
            counts: Param::initialized(burn::module::ParamId::new(), Tensor::from_data([3, -7], device)),
            mask: Param::initialized(
                burn::module::ParamId::new(),
                Tensor::from_data([[true, false]], device),
            ),
        }
    }

    fn loss(net: &Net, x: &Tensor<4>) -> Tensor<1> {
        let [n, ..] = x.dims();
        let x = net.norm.forward(net.conv.forward(x.clone())).mean_dim(3).mean_dim(2).reshape([n, 4]);
        let x = x * net.depth.val().reshape([1, 4]);
        net.heads[0].forward(x.clone()).square().mean() + net.heads[1].forward(x).square().mean()
    }

    /// All tensors of a module with their names and ids, as Burn writes them.
    fn record(net: &Net) -> Vec<u8> {
        net.valid().into_record().into_bytes().unwrap().to_vec()
    }

    fn images(device: &Device, seed: u64) -> Tensor<4> {
        device.seed(seed);
        Tensor::random([2, 3, 8, 8], Distribution::Default, device)
    }

    #[test]
    fn the_parameters_are_the_networks_with_names_ids_and_kinds() {
        let device = Device::flex();
        let original = net(&device);
        let parameters = Parameters::of(&original);
        assert_eq!(parameters.num_params(), original.num_params());
        assert_eq!(parameters.devices(), original.devices());
        assert_eq!(parameters.into_record().into_bytes().unwrap().to_vec(), record(&original));
        // Loads them into another network of the same kind, which Burn then treats as the first one.
        device.seed(4);
        let mut other = Network::new(net(&device.clone()).map(&mut Doubled));
        assert_ne!(numbers(&original), numbers(other.0.as_ref().unwrap()));
        Parameters::of(&original).put_into(&mut other);
        assert_eq!(numbers(&original), numbers(&other.into_inner()));
    }

    /// The content of a weight file: everything but the ids, which running statistics keep.
    fn numbers(net: &Net) -> Vec<u8> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("weights.safetensors");
        crate::weights::save_weights(net, &crate::weights::ModelCard::new("net", "A network"), &file)
            .unwrap();
        std::fs::read(file).unwrap()
    }

    struct Doubled;

    impl ModuleMapper for Doubled {
        fn map_float<const D: usize>(&mut self, parameter: Param<Tensor<D>>) -> Param<Tensor<D>> {
            parameter.map(|tensor| tensor.mul_scalar(2.0))
        }

        fn map_int<const D: usize>(&mut self, parameter: Param<Tensor<D, Int>>) -> Param<Tensor<D, Int>> {
            parameter.map(|tensor| tensor.mul_scalar(2))
        }
    }

    #[test]
    fn steps_are_burns_own_bit_for_bit() {
        let device = Device::flex().autodiff();
        let options = TrainingOptions {
            steps: 3,
            learning_rate: 1e-2,
            warm_up: 0,
            weight_decay: 0.01,
            max_grad_norm: Some(0.1),
            seed: 0,
        };
        let mut burns = net(&device).train();
        let mut ours = Learner::adam_w("network", burns.clone(), &options);
        let config = AdamWConfig::new()
            .with_weight_decay(options.weight_decay)
            .with_grad_clipping(options.max_grad_norm.map(burn::grad_clipping::GradientClippingConfig::Norm));
        let mut optimiser = config.init();
        let start = record(&burns);
        for step in 0..3 {
            let (mut sum, mut accumulator) = (GradientSum::new(), GradientsAccumulator::new());
            for image in 0..2 {
                let x = images(&device, 10 * step + image);
                let mut gradients = loss(ours.network(), &x).backward();
                sum.add(ours.network(), gradients_of(&mut gradients, ours.network()));
                let gradients = GradientsParams::from_grads(loss(&burns, &x).backward(), &burns);
                accumulator.accumulate(&burns, gradients);
            }
            ours.step(1e-2, sum.into_gradients());
            burns = optimiser.step(1e-2, burns, accumulator.grads());
            assert_eq!(record(ours.network()), record(&burns), "step {step}");
        }
        assert_ne!(start, record(&burns));
    }
}
