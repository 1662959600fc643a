#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Adam {
    /// Value in the optimization space.
    pub value: f64,
    /// Means of gradients and squared gradients.
    pub moments: [f64; 2],
}

impl Adam {
    /// Returns the state after step `step`, from 1.
    pub fn stepped(self, gradient: f64, step: i32, rate: f64, [beta1, beta2]: [f64; 2], eps: f64) -> Adam {
        let mean = beta1 * self.moments[0] + (1.0 - beta1) * gradient;
        let square = beta2 * self.moments[1] + (1.0 - beta2) * gradient.powi(2);
        let unbiased = [mean / (1.0 - beta1.powi(step)), square / (1.0 - beta2.powi(step))];
        Adam { value: self.value - rate * unbiased[0] / (unbiased[1].sqrt() + eps), moments: [mean, square] }
    }
}
