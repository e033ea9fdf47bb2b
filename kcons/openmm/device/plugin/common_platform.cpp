// OpenCL, CUDA and HIP, by OpenMM's Common interface: one library for each, with PLATFORM its name.
#include "program_integrator.h"
#include "openmm/KernelFactory.h"
#include "openmm/Platform.h"
#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include "openmm/common/ComputeForceInfo.h"
#include "openmm/common/ContextSelector.h"
#include "openmm/common/IntegrationUtilities.h"
#include "openmm/opencl/OpenCLPlatform.h"
#include <algorithm>
using namespace OpenMM;
using namespace std;

namespace kcons {

// Two atoms that belong together: OpenMM moves molecules as wholes, and different ones to other places.
class Together : public ComputeForceInfo {
public:
    Together(const vector<int>& tied) : tied(tied) {}
    int getNumParticleGroups() override { return tied.size()/2; }
    void getParticlesInGroup(int k, vector<int>& particles) override { particles = {tied[2*k], tied[2*k+1]}; }
    bool areGroupsIdentical(int, int) override { return true; }
private:
    vector<int> tied;
};

class CommonStep : public StepKernel {
public:
    CommonStep(const string& name, const Platform& platform, ComputeContext& cc) : StepKernel(name, platform), cc(cc) {}
    void execute(ContextImpl& c, ProgramIntegrator& integrator, int steps) override {
        ContextSelector selector(cc);
        cc.getIntegrationUtilities().setNextStepSize(integrator.getStepSize());
        if (!valid && arrays.count("cells")) follow();   // who sets positions begins to count cells anew
        StepKernel::execute(c, integrator, steps);
    }
    void lookBack() override { ContextSelector selector(cc); StepKernel::lookBack(); }
    double kineticEnergy() override {
        ContextSelector selector(cc);
        return cc.getIntegrationUtilities().computeKineticEnergy(0);
    }
    vector<double> read(const string& name) override {
        ContextSelector selector(cc);
        if (declared(name).whole) return downloaded<int>(name);
        return wide ? downloaded<double>(name) : downloaded<float>(name);
    }
    void write(const string& name, const vector<double>& values) override {
        ContextSelector selector(cc);
        if (declared(name, values.size()).whole) arrays.at(name).upload(vector<int>(values.begin(), values.end()));
        else arrays.at(name).upload(values, true);
    }
    void begin(ContextImpl& c, const vector<int>& tied) override {
        ContextSelector selector(cc);
        if (!tied.empty()) cc.addForce(new Together(tied));
        cc.initializeContexts();
    }
protected:
    void prepare(ContextImpl& c) override {
        ContextSelector selector(cc);
        wide = cc.getUseDoublePrecision() || cc.getUseMixedPrecision();
        for (auto& array : plan.arrays) {
            int size = array.whole ? sizeof(int) : wide ? sizeof(double) : sizeof(float);
            arrays[array.name].initialize(cc, array.values.size(), size, array.name);
            write(array.name, array.values);
        }
        forces.resize(plan.slots > 1 ? plan.slots : 0);
        for (auto& saved : forces) saved.initialize<long long>(cc, cc.getLongForceBuffer().getSize(), "kconsForces");
        follow();
        cc.addReorderListener(new Follower(*this));
        program = cc.compileProgram(plan.source);
    }
    void launch(const string& name) override {
        ComputeKernel& kernel = kernels[name];
        // Arguments in the order of `kernels.py`: numbers, OpenMM's arrays, forces of each group, own arrays.
        if (!kernel) {
            kernel = program->createKernel(name);
            kernel->addArg(cc.getPaddedNumAtoms());
            for (int k = 0; k < 8; k++) kernel->addArg();
            kernel->addArg(cc.getPosq());
            kernel->addArg(cc.getUseMixedPrecision() ? cc.getPosqCorrection() : cc.getPosq());
            kernel->addArg(cc.getVelm());
            kernel->addArg(cc.getAtomIndexArray());
            for (int slot = 0; slot < plan.slots; slot++)
                if (forces.empty()) kernel->addArg(cc.getLongForceBuffer());
                else kernel->addArg(forces[slot]);
            for (auto& array : plan.arrays) kernel->addArg(arrays[array.name]);
        }
        kernel->setArg(1, numbers.step);
        kernel->setArg(2, numbers.launch++);
        const double given[] = {numbers.dt, numbers.time, numbers.tolerance};
        for (int k = 0; k < 3; k++) if (wide) kernel->setArg(3+k, given[k]); else kernel->setArg(3+k, (float) given[k]);
        for (int k = 0; k < 3; k++) {
            const Vec3& b = numbers.box[k];
            if (wide) kernel->setArg(6+k, mm_double4(b[0], b[1], b[2], 0));
            else kernel->setArg(6+k, mm_float4(b[0], b[1], b[2], 0));
        }
        int size = plan.workGroup, groups = min((plan.items+size-1)/size, 256);
        kernel->execute(max(groups, 1)*size, size);
    }
    void positionsMoved() override { cc.reorderAtoms(); }
    void keepForces(int slot) override { cc.getLongForceBuffer().copyTo(forces[slot]); }
private:
    // Where atoms are, after OpenMM has moved them to other places.
    class Follower : public ComputeContext::ReorderListener {
    public:
        Follower(CommonStep& step) : step(step) {}
        void execute() override { step.follow(); }
    private:
        CommonStep& step;
    };
    template <class T> vector<double> downloaded(const string& name) {
        vector<T> values;
        arrays.at(name).download(values);
        return vector<double>(values.begin(), values.end());
    }
    void follow() {
        const vector<int>& index = cc.getAtomIndex();
        vector<int> place(index.size()), now;
        for (int k = 0; k < cc.getNumAtoms(); k++) place[index[k]] = k;
        // Of particles that rest -1-k, as at first.
        for (int k : declared("atoms").values) now.push_back(k < 0 ? -1-place[-1-k] : place[k]);
        arrays.at("atoms").upload(now);
        if (arrays.count("cells") == 0) return;
        vector<int> cells;
        for (int k = 0; k < cc.getNumAtoms(); k++) {
            mm_int4 by = cc.getPosCellOffsets()[k];
            cells.insert(cells.end(), {by.x, by.y, by.z});
        }
        arrays.at("cells").upload(cells);
    }
    ComputeContext& cc;
    ComputeProgram program;
    map<string, ComputeArray> arrays;
    map<string, ComputeKernel> kernels;
    vector<ComputeArray> forces;
    bool wide = false;   // whether `mixed` is double
};

class CommonFactory : public KernelFactory {
    KernelImpl* createKernelImpl(string name, const Platform& platform, ContextImpl& c) const override {
        // PlatformData of OpenCL, CUDA and HIP alike begin with the Context and the vector of their contexts, each of
        // which has ComputeContext as its first base.
        auto* data = reinterpret_cast<OpenCLPlatform::PlatformData*>(c.getPlatformData());
        if (data->contexts.size() != 1) throw OpenMMException("kcons: steps on the device run on one device; give one DeviceIndex, or device=False");
        return new CommonStep(name, platform, *reinterpret_cast<ComputeContext*>(data->contexts[0]));
    }
};

}

extern "C" void registerPlatforms() {}
extern "C" void registerKernelFactories() {
    for (int k = 0; k < Platform::getNumPlatforms(); k++)
        if (Platform::getPlatform(k).getName() == PLATFORM)
            Platform::getPlatform(k).registerKernelFactory(kcons::StepKernel::Name(), new kcons::CommonFactory());
}
