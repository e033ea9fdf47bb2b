// A time step as a list of actions, as an OpenMM::Integrator. What a GPU needs is in common_platform.cpp.
#pragma once
#include "openmm/Integrator.h"
#include "openmm/Kernel.h"
#include "openmm/KernelImpl.h"
#include "openmm/OpenMMException.h"
#include "openmm/internal/ContextImpl.h"
#include <map>
#include <string>
#include <vector>

namespace kcons {

// An array that kernels know by its name; `saved` if it belongs to a state.
struct Array {
    std::string name;
    bool whole, saved;             // whole numbers
    std::vector<double> values;    // that it begins with
};

// Launches a kernel, or, where it has no name, evaluates forces.
struct Action {
    std::string kernel;
    int groups;                    // of forces, a bit mask
    int slot;                      // where these forces are, among those of all groups
};

// What Python makes of an integrator for one Context: kernels, their arrays, and in which order they run. n steps are
// the head, n-1 times the middle, which is the end of a step and the head of the next, and the tail.
struct Plan {
    // What there is: masses; i, j and length of each constraint; positions, box (zeros if there is none) and time.
    std::map<std::string, std::vector<double>> given;
    std::string source, library;   // of the kernels; for plain C++ the file that they were compiled to
    std::vector<Array> arrays;
    std::vector<Action> parts[3];
    int items = 0, workGroup = 64, slots = 1;
};

// Python's part in the making: fills the plan for an integrator, an OpenMM::Integrator*, or returns 0.
typedef int (*Planner)(Plan* plan, const void* integrator, const char* description, const char* platform, int groups);

// What Python reads and writes directly.
struct Shared {
    int whole = 1;                 // whether others look at velocities between steps, which must then end
    int noisy = 0;                 // whether the kinetic energy is that of the middle of the last step
    int every = 0, since = 0;      // steps from one record to the next, 0 for none, and the step that they count from
    int moved = 0;                 // whether others have set positions or velocities since the last step
    int bound = 0, planned = 0;    // whether there is a Context, and whether it has its kernels; not after reinitialize
    double origin = 0;             // time that kernels count from
    double told[7] = {};           // by the kernel `look`, at the end of the last call
};

class StepKernel;

class ProgramIntegrator : public OpenMM::Integrator {
public:
    std::string description;       // what Python makes the plan of
    std::vector<int> tied;         // pairs of atoms that stay together, beside those of constraints of the System
    mutable Shared shared;
    void step(int steps) override;
    std::vector<double> read(const std::string& name) const;
    void write(const std::string& name, const std::vector<double>& values);
protected:
    void initialize(OpenMM::ContextImpl& c) override;
    void cleanup() override;
    std::vector<std::string> getKernelNames() override;
    void stateChanged(OpenMM::State::DataType changed) override;
    double computeKineticEnergy() override;
    bool kineticEnergyRequiresForce() const override { return false; }
    void createCheckpoint(std::ostream& out) const override;
    void loadCheckpoint(std::istream& in) override;
    void serializeParameters(OpenMM::SerializationNode& node) const override;
    void deserializeParameters(const OpenMM::SerializationNode& node) override;
private:
    StepKernel& kernel() const;    // with all that it needs, which is made when it is used first
    Plan made() const;
    std::string saved() const;     // all that belongs to a state beside x and v: numbers
    // `exactly` that of these rows; else arrays of other rows stay as they are.
    void restore(const std::string& text, bool exactly);
    mutable OpenMM::Kernel handle;
    // Of the middle of the last step, and of the velocities that it ended with: those of others have another. -1: none.
    double middleKinetic = -1, endKinetic = -1;
};

// What platforms have in common; each says how a kernel is launched and where arrays are.
class StepKernel : public OpenMM::KernelImpl {
public:
    static std::string Name() { return "KconsStep"; }
    StepKernel(const std::string& name, const OpenMM::Platform& platform) : KernelImpl(name, platform) {}
    virtual void begin(OpenMM::ContextImpl& c, const std::vector<int>& tied) = 0;
    void build(OpenMM::ContextImpl& c, const Plan& made) { plan = made; prepare(c); }
    virtual void execute(OpenMM::ContextImpl& c, ProgramIntegrator& integrator, int steps);
    virtual double kineticEnergy() = 0;
    virtual std::vector<double> read(const std::string& name) = 0;
    virtual void write(const std::string& name, const std::vector<double>& values) = 0;
    virtual void lookBack() { launch("look"); }   // sums and failures to the array `looked`
    bool valid = false;            // whether forces are those at the present positions
    Plan plan;
protected:
    struct Numbers { int step, launch; double dt, time, tolerance; OpenMM::Vec3 box[3]; };
    Numbers numbers = {};
    const Array& declared(const std::string& name, long size = -1) const;   // refuses values of another number
    virtual void prepare(OpenMM::ContextImpl& c) = 0;
    virtual void launch(const std::string& kernel) = 0;
    virtual void positionsMoved() {}           // before the first evaluation at new positions
    virtual void keepForces(int slot) = 0;     // where there are several groups
private:
    void run(OpenMM::ContextImpl& c, const Shared& shared, int part);
    void evaluate(OpenMM::ContextImpl& c, const Action& action);
};

}
